"""Every figure as a panel: what draws it on axes, and what is said of it."""
