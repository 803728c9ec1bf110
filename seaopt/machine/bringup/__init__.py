"""The stages of a bring-up: what is played, logged and expected, as files and as a page."""
