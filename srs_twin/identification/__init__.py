"""What is known of a robot from runs, measurements and its own recordings.

`read_motion` reads what cameras saw of it, `read_valves` what was done to its air, `join` puts both on one
clock. `footprint.study` measures what it sweeps.
"""
