"""Identification of a robot from runs, measurements and recordings.

`read_motion` reads motion capture, `read_valves` logs of valves or pressures, and
`join` puts both on one clock. `footprint.footprint_study` measures footprints.
"""
