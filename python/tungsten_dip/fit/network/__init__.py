"""The small network that blends the pilots: what it sees, and how it is trained."""
