"""Control laws: their specification, structures and gains; the tuned controller, how it is stored and how it runs."""
