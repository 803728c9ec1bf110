"""The exported law on nonlinear plants: scenarios, playback, judgement and environments."""
