#!/bin/sh
# Make .venv and install pc2grid with its tools for developers into it. Called by the Makefile.
#
# What is missing of Python and of the five libraries that open3d needs, even without a screen, root gets from
# apt; anyone else is told the one line to type. The same holds for chromium, in which tests look at pages:
# `setup.sh browser` brings it, and nothing else. Without it they are skipped.
set -eu

fail() {
    echo "setup: $1" >&2
    [ $# -lt 2 ] || echo "  $2" >&2
    exit 1
}

has_apt() { command -v apt-get >/dev/null 2>&1; }
is_root() { [ "$(id -u)" -eq 0 ]; }

# A Python from 3.10 to 3.13; open3d has no wheels for others.
fits() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1; }
has_venv() { "$1" -c 'import venv, ensurepip' >/dev/null 2>&1; }

find_python() {
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.10}; do
        if fits "$candidate" && has_venv "$candidate"; then
            echo "$candidate"
            return
        fi
    done
}

apt_install() { # why, then package names
    why=$1
    shift
    has_apt || fail "$why; install what your system calls: $*"
    is_root || fail "$why; install with:" "sudo apt-get update && sudo apt-get install -y $*"
    echo "setup: $why; installing $*"
    apt_get "$@" || fail "apt-get could not install $*"
}

apt_get() { # package names
    apt-get update -q >&2 || echo "setup: apt-get update failed, trying with the lists that are there" >&2
    DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@" >&2
}

has_browser() { command -v chromium >/dev/null 2>&1 || command -v chromium-browser >/dev/null 2>&1; }

if [ "${1:-}" = browser ]; then
    if ! has_browser && has_apt && is_root; then
        echo "setup: tests look at pages in chromium; installing it"
        apt_get chromium || :
    fi
    has_browser || echo "setup: no chromium, so tests of pages are skipped; on Debian: sudo apt-get install chromium" >&2
    exit 0
fi

missing_libraries() { # prints the packages that hold what cannot be loaded
    "$1" - <<'END'
import ctypes
import sys

NEEDED = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
for library, package in NEEDED.items() if sys.platform == "linux" else ():
    try:
        ctypes.CDLL(library)
    except OSError:
        print(package)
END
}

python=$(find_python)
if [ -z "$python" ]; then
    [ -z "${PYTHON:-}" ] || fail "PYTHON=$PYTHON is not a Python 3.10 to 3.13 with venv"
    wanted="no Python 3.10 to 3.13 with venv found (make PYTHON=/path/to/python3.11 ... uses the one you name)"
    apt_install "$wanted" python3 python3-venv
    python=$(find_python)
    [ -n "$python" ] || fail "$wanted"
fi

# Run a command while a line says how long it has taken and how much is installed.
watched() { # command and arguments
    "$@" &
    job=$!
    trap 'kill "$job" 2>/dev/null; exit 130' INT TERM  # a job in the background does not see Ctrl-C
    if [ -t 2 ]; then every=1 start='\r' end=''; else every=20 start='' end='\n'; fi
    seconds=0
    while kill -0 "$job" 2>/dev/null; do
        # shellcheck disable=SC2059  # the format is ours
        [ $((seconds % every)) -ne 0 ] || printf "${start}setup: %d s, %d MB of about 1800 MB${end}" \
            "$seconds" "$(du -sm .venv 2>/dev/null | cut -f 1)" >&2
        sleep 1
        seconds=$((seconds + 1))
    done
    [ ! -t 2 ] || printf '\n' >&2
    wait "$job"
}

packages=$(missing_libraries "$python")
# shellcheck disable=SC2086  # one word per package
[ -z "$packages" ] || apt_install "open3d needs libraries that are missing here" $packages

.venv/bin/python -c 'import pip' >/dev/null 2>&1 || watched "$python" -m venv --clear .venv
echo "setup: installing into .venv with $(.venv/bin/python --version) (the first time takes some minutes)"
watched .venv/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]' ||
    fail "pip could not install pc2grid; its message is above"
# The first import of so much takes seconds: here they are seen, and not at the first command.
watched .venv/bin/python -c 'import open3d, pc2grid_cli.demo' || fail "open3d does not load; its message is above"
echo "setup: ready"
