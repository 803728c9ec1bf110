"""Tuning until certified: the reserve that draws need, rounds of tuning and certifying, what must give."""
