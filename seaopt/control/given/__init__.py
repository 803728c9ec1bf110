"""Laws that were not tuned here: how they are given, and what they achieve."""
