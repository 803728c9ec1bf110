"""Which gains a schedule's table has, told by what it commanded."""
