"""Tungsten's scene files as typed objects, and the effects that a scene calls for."""
