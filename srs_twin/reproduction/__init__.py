"""The dissertation's claims as rows: each one statement, the runs that produce it, and a verdict a plant."""
