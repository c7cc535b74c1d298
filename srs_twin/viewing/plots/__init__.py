"""Plots of runs and sweeps."""

from srs_twin.errors import InputError

try:
    import matplotlib  # noqa: F401
except (
    ValueError,
    OSError,
) as error:  # the import reads the user's settings
    raise InputError(
        f"matplotlib cannot be imported: {error}; check your file matplotlibrc and the"
        " environment variable MPLBACKEND"
    ) from error
