"""An acceptance in words: its verdict, its sections, its figures, and the page."""
