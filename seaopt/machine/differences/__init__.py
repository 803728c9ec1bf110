"""What differs between the machine and what was certified: the response of both, and the causes."""
