# Sets geomtact up in .venv; sourced by quickstart.sh and test.sh from the top of the checkout (POSIX sh).

say() { printf 'setup: %s\n' "$*" >&2; }
stop() {
    say "$*"
    exit 1
}

# Name and Debian package of the libraries that Open3D loads.
LIBRARIES="libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libEGL.so.1:libegl1 libgomp.so.1:libgomp1 libX11.so.6:libx11-6"

find_python() {
    for python in python3.11 python3.12 python3.13 python3 python; do
        if "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
            echo "$python"
            return
        fi
    done
    found=$(python3 --version 2>&1) || found="no python3"
    stop "Python 3.11 or newer is needed, but PATH has $found; install python3.11 and run this again"
}

missing_packages() {
    known=$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p 2>/dev/null) || known=
    for entry in $LIBRARIES; do
        case "$known" in
        *"${entry%%:*} "*) ;;
        *) printf '%s ' "${entry#*:}" ;;
        esac
    done
    "$1" -c 'import ensurepip, venv' >/dev/null 2>&1 || printf 'python3-venv '
}

install_packages() { # the packages that missing_packages named
    if [ "$(id -u)" = 0 ]; then
        as_root=
    elif sudo -n true 2>/dev/null; then
        as_root=sudo
    else
        stop "system packages are missing; run 'sudo apt-get update && sudo apt-get install $1' and then this again"
    fi
    command -v apt-get >/dev/null || stop "system packages are missing: install $1 (Debian's names) and run this again"
    say "installing system packages: $1"
    # shellcheck disable=SC2086  # words are meant to split
    { $as_root apt-get update -qq && $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $1; } >&2 ||
        stop "apt-get failed; run 'sudo apt-get update && sudo apt-get install $1' and then this again"
}

# pip takes a build marked "+cpu" where it is offered one; otherwise torch for Linux brings CUDA's libraries along.
announce_torch() {
    pin=$(sed -n 's/^torch==//p' tools/constraints.txt)
    .venv/bin/python -c "import importlib.metadata as m; assert m.version('torch').split('+')[0] == '$pin'" 2>/dev/null &&
        return 0
    need_mb=4000
    offers=" $(.venv/bin/python -m pip index versions torch 2>/dev/null | tr ',\n' '  ') "
    case "$offers" in
    *" $pin+cpu "*) say "downloading: torch $pin (CPU build) and the other libraries, about 1 GB" ;;
    *" $pin "*)
        need_mb=11000
        say "downloading: only builds of torch $pin with CUDA are offered here, about 2.7 GB, and 0.8 GB of other libraries"
        ;;
    *) say "downloading: about 1 GB, or 3.5 GB if torch comes with CUDA" ;;
    esac
    free_mb=$(df -Pm . | awk 'NR == 2 { print $4 }')
    [ "$free_mb" -ge "$need_mb" ] ||
        stop "$need_mb MB of disk are needed for .venv, but only $free_mb MB are free here; free some and run this again"
}

# set_up EXTRA: EXTRA is "run" (geomtact as users have it) or "dev" (with what the tests need)
set_up() {
    extra=$1
    [ -f setup.cfg ] || stop "run this in the top folder of geomtact's checkout"
    key=$(cat setup.cfg tools/constraints.txt tools/setup.sh | cksum)-$PWD
    for done in .venv/.set-up-dev ".venv/.set-up-$extra"; do
        if [ "$(cat "$done" 2>/dev/null)" = "$key" ]; then
            return 0
        fi
    done

    began=$(date +%s)
    python=$(find_python) || exit 1
    packages=$(missing_packages "$python")
    if [ -n "$packages" ]; then
        install_packages "${packages% }"
        packages=$(missing_packages "$python")
        [ -z "$packages" ] || stop "still missing for $(command -v "$python"): ${packages% }; install them and run this again"
    fi
    if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
        say "making .venv with $("$python" --version)"
        "$python" -m venv --clear .venv || stop "cannot make .venv (see above); is the disk full or the folder read-only?"
    fi
    announce_torch
    wanted=.
    [ "$extra" = dev ] && wanted='.[dev]'
    rm -f .venv/pip.log
    # setuptools first: without build isolation the pinned one builds geomtact, too
    for what in setuptools "--no-build-isolation -e $wanted"; do
        # shellcheck disable=SC2086  # words are meant to split
        .venv/bin/python -m pip install --log .venv/pip.log --disable-pip-version-check --progress-bar off --no-warn-conflicts \
            -c tools/constraints.txt $what >&2 || stop "pip could not install geomtact (see above; all of it is in .venv/pip.log)"
    done
    echo "$key" >".venv/.set-up-$extra"
    fetched=$(sed -n 's/.*Downloading .* (\([0-9.]*\) \([kMG]\)B)$/\1 \2/p' .venv/pip.log |
        awk '{ mb += $1 * ($2 == "G" ? 1000 : $2 == "k" ? 0.001 : 1) } END { printf "%.0f", mb }')
    say "done in $(($(date +%s) - began)) s: $fetched MB downloaded, .venv takes $(du -sm .venv | cut -f1) MB"
}
