"""Buffers of a render: the data model, files, sanitising, checks of half buffers, pre-filtering."""
