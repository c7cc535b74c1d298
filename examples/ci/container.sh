#!/bin/sh
# Starts srs-twin in the container with caches that only the user who runs it can write: those of kernels are
# pickles. The container may be started as any user, who may have no home folder.
private=${TMPDIR:-/tmp}/srs-twin-$(id -u)
mkdir -m 700 "$private" 2>/dev/null
# An earlier one is used only if it is a folder of this user to which no other user has had access.
if [ -L "$private" ] || ! [ -O "$private" ] || [ "$(stat -c %F:%a "$private")" != directory:700 ]; then
    private=$(mktemp -d) || exit 2
fi
export NUMBA_CACHE_DIR="${NUMBA_CACHE_DIR:-$private/numba}" MPLCONFIGDIR="${MPLCONFIGDIR:-$private/matplotlib}"
exec "$(dirname "$0")/../bin/srs-twin" "$@"
