"""Controllers that also compensate what is known of their plant."""
