"""One module per kind of result: its sections, and its verdict."""
