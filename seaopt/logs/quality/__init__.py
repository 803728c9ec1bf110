"""What is wrong with the data of a log, and what they can tell."""
