"""The published method (preset ``paper``), with torch; its `constants` and `images` do without."""
