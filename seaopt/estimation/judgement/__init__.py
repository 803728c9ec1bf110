"""What is wrong with a fit: findings, and which of them forbid to use it."""
