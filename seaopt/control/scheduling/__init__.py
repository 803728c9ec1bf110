"""Gains over a measured signal or a load: tables, their tuning, and the law that interpolates them as it runs."""
