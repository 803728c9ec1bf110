"""The certificate: requirements, verdict, and tuning until it passes."""
