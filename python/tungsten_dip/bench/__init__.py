"""Measures accuracy against time: our fits, other denoisers and the published method."""
