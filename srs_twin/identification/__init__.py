"""Identification of robot parameters from runs, measurements and recordings.

`read_motion` reads motion capture and `read_valves` reads logs of valves or pressures.
`join` puts both on one clock.
"""
