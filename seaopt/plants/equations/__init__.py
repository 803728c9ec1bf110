"""The equations of a plant as data: as text that users write, and as CasADi functions that pickle."""
