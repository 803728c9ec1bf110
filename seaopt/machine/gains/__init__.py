"""Which gains a law, or a schedule's table, has, told by what it commanded."""
