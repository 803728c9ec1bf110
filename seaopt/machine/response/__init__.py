"""The response of a loop from the periods of its logs, and what they say of its limits."""
