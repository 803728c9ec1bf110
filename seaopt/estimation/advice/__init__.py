"""Advice on fits: diagnostics, score tests of fixed parameters, comparison and ranking of models."""
