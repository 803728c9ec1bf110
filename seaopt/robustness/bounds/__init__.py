"""The worst case from above: Taylor models, enclosures, branch and bound."""
