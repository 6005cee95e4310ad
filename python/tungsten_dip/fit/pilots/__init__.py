"""Pilots, estimates of the clean image that filters compute, and what they need."""
