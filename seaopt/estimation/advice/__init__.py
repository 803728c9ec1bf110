"""What a fit says of itself: diagnostics, score tests of fixed parameters, comparison and ranking of models."""
