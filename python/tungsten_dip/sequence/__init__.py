"""Frames that follow one another: each starts from what is known of the one before. On one machine or many.

`frames` finds which files are frames, `following` denoises one frame after another, `reprojection` moves the
previous frame into place, `flicker` measures how steady the result is, `work` reads and writes the files of a
run that may be killed at any time, `cluster` spreads it over Dask workers and `page` reports on it.
"""
