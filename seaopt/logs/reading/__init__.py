"""Raw files to tables and logs: which columns, on which clock, in which unit."""
