"""Errors without a reference: how well an image of one half predicts the other half."""
