"""Plots of runs and sweeps."""

from srs_twin.errors import InputError

try:
    import matplotlib  # noqa: F401
except (
    ValueError,
    OSError,
) as error:  # matplotlib reads the user's settings when it is imported
    raise InputError(
        f"matplotlib cannot start: {error}; correct or remove your file matplotlibrc,"
        " and the environment variable MPLBACKEND"
    ) from error
