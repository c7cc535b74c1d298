"""Checks of the installation and the machine for `srs-twin doctor`, with remedies.

`checks` contains what this process can find out itself. Tests that may crash, hang or leave files behind are
probes (`probes`) and run in child processes; `examination` starts them and collects all checks.
"""
