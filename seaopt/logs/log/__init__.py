"""A log: channels on one clock, and what can be done to it: cut, resample, decimate, append, mask."""
