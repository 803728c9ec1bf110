"""The judgement of a fit: its findings, and which of them forbid its use."""
