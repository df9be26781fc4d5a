#!/bin/sh
# Makes a virtual environment that holds the locked packages and this project, and whatever the system lacks for that.
#
#   deploy/bootstrap.sh [-e] [-t TOOL=PACKAGE]... VENV LOCK
#
#   -e                    install the project editable, for work on it; without -e it is copied into the environment
#   -t TOOL=PACKAGE       a command or a library (NAME.so.N) of the system that is wanted, not needed: installed where that
#                         is allowed, otherwise named
#
# What is needed (Python >= 3.11, its venv module, libgomp.so.1) and missing is installed through apt by root or with a
# sudo that asks for no password; otherwise one sentence says what to do. The interpreter is $PYTHON, or the first of
# python3, python3.14 ... python3.11 that is recent enough. Repeating it costs nothing while lock and project are the same.
set -eu

die() {
    echo "rigcal set-up: $*" >&2
    exit 1
}

find_python() {
    found=''
    for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
        if version=$("$candidate" -c 'import sys
print("%d.%d" % sys.version_info[:2])
sys.exit(sys.version_info < (3, 11))' 2>/dev/null); then
            python=$candidate
            return
        fi
        [ -z "$version" ] || found="$found $candidate is $version;"
    done
    die "Python 3.11 or newer is needed;${found:- no Python was found;} install one, or name it: make PYTHON=/path/to/python3.11 ..."
}

has_library() { "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$1" 2>/dev/null; }

has_tool() {
    case $1 in
    *.so.*) has_library "$1" ;;
    # Debian keeps some administrators' commands where a user's PATH does not look.
    *) PATH="$PATH:/usr/sbin:/sbin" command -v "$1" >/dev/null ;;
    esac
}

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

may_install() {
    command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }
}

install_system_packages() {
    echo "Installing system packages:$*"
    # A repository of somebody else's that does not answer is no reason to stop; the installation below decides.
    as_root apt-get -q update || true
    # shellcheck disable=SC2086 # a list of package names
    as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get -q -o DPkg::Lock::Timeout=300 install -y --no-install-recommends $1 ||
        die "apt-get could not install$1; its message is above"
}

editable=''
tools=''
while getopts et: option; do
    case $option in
    e) editable=yes ;;
    t) tools="$tools $OPTARG" ;;
    *) die "usage: bootstrap.sh [-e] [-t TOOL=PACKAGE]... VENV LOCK" ;;
    esac
done
shift $((OPTIND - 1))
[ $# = 2 ] || die "usage: bootstrap.sh [-e] [-t TOOL=PACKAGE]... VENV LOCK"
venv=$1
lock=$2
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
[ -r "$lock" ] || die "the lock file $lock cannot be read"

find_python

needed=''
"$python" -c 'import ensurepip, venv' 2>/dev/null || needed="$needed python$version-venv"
has_library libgomp.so.1 || needed="$needed libgomp1"
wanted=''
for tool in $tools; do
    has_tool "${tool%%=*}" || wanted="$wanted ${tool#*=}"
done

if [ -n "$needed$wanted" ]; then
    if may_install; then
        install_system_packages "$needed$wanted"
    elif [ -n "$needed" ]; then
        die "system packages are missing and may not be installed from here; run: sudo apt-get install$needed$wanted"
    else
        echo "rigcal set-up: tests that need them are skipped until you run: sudo apt-get install$wanted" >&2
    fi
fi

# The environment is made anew when its interpreter has gone (a system upgrade) and left alone otherwise.
if ! "$venv/bin/python" -c '' 2>/dev/null; then
    "$python" -m venv --clear "$venv" || die "the virtual environment $venv could not be made; Python's message is above"
fi

export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1 PIP_ROOT_USER_ACTION=ignore
stamp="$venv/.rigcal-set-up"
state=$(cat "$lock" "$root/pyproject.toml" "$root/deploy/bootstrap.sh" | sha256sum)" $root"
if [ -z "$editable" ] || [ "$(cat "$stamp" 2>/dev/null)" != "$state" ]; then
    rm -f "$stamp"
    echo "Installing $(grep -c '^[a-z]' "$lock") locked packages into $venv (the first time takes a minute or two)"
    # Wheels alone: a source package would run its own build, with tools that no hash covers.
    "$venv/bin/python" -m pip install --quiet --no-deps --require-hashes --only-binary :all: -r "$lock" ||
        die "pip could not install the locked packages ($lock) for Python $version; its message is above. If it speaks of" \
            "connections or retries, the package index cannot be reached: check the network or pip's proxy and index settings"
    if [ -n "$editable" ]; then
        # A path (compat) and not a finder, which is asked after the path: in the parent of a clone named rigcal the
        # clone itself would be the package, and an empty one. setuptools warns of every editable installation.
        PYTHONWARNINGS=ignore "$venv/bin/python" -m pip install --quiet --no-deps --no-build-isolation \
            --config-settings editable_mode=compat --editable "$root"
    else
        # What an earlier build left behind would be packed again.
        rm -rf "$root/build"
        "$venv/bin/python" -m pip install --quiet --no-deps --no-build-isolation --force-reinstall "$root"
    fi || die "the project in $root could not be installed; pip's message is above"
    [ -z "$editable" ] || echo "$state" >"$stamp"
fi
