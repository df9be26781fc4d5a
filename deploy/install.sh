#!/bin/sh
# Installs rigcal as a service on a rig's computer, or upgrades it. Run as root, from a checkout; run it again at will.
#
#   deploy/install.sh               the program in /opt/rigcal/venv, its user, the service (neither enabled nor started)
#   DESTDIR=DIR deploy/install.sh   only the files, under DIR: what a package would hold besides the program
#
# Files that a site edits (/etc/rigcal/rigcal.toml, the udev rule, the CAN interface) are never overwritten.
set -eu
umask 022

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
DESTDIR=${DESTDIR:-}

die() {
    echo "rigcal installation: $*" >&2
    exit 1
}

place() { install -D -m 0644 "$here/$1" "$DESTDIR$2"; }

place_once() {
    if [ -e "$DESTDIR$2" ]; then
        echo "kept $DESTDIR$2"
    else
        place "$1" "$2"
    fi
}

# The script by which a shell completes rigcal's commands and options.
complete() {
    install -d "$(dirname "$2")"
    /opt/rigcal/venv/bin/rigcal completion "$1" >"$2"
}

place_files() {
    place rigcal.service /etc/systemd/system/rigcal.service
    place rigcal-jobs.socket /etc/systemd/system/rigcal-jobs.socket
    place rigcal-jobs@.service /etc/systemd/system/rigcal-jobs@.service
    place rigcal-clock.socket /etc/systemd/system/rigcal-clock.socket
    place rigcal-clock@.service /etc/systemd/system/rigcal-clock@.service
    place system-rigcaljobs.slice /etc/systemd/system/system-rigcaljobs.slice
    place network.conf /opt/rigcal/network.conf
    place rigcal-web.service /etc/systemd/system/rigcal-web.service
    place rigcal.sysusers /etc/sysusers.d/rigcal.conf
    place rigcal.modules-load /etc/modules-load.d/rigcal.conf
    place rigcal.sysctl /etc/sysctl.d/60-rigcal.conf
    place_once rigcal.toml /etc/rigcal/rigcal.toml
    place_once 99-rigcal-station.rules /etc/udev/rules.d/99-rigcal-station.rules
    place_once 80-can0.network /etc/systemd/network/80-can0.network
}

if [ -n "$DESTDIR" ]; then
    place_files
    exit
fi

[ "$(id -u)" = 0 ] || die "this changes /opt, /etc and the list of users; run it as root"
command -v systemctl >/dev/null || die "systemd is not installed here; rigcal's service needs it"
booted=''
[ ! -d /run/systemd/system ] || booted=yes # sd_booted(3): false in a chroot or an image being built

# Packages are not changed under a running daemon; it is started again whatever becomes of the installation, also when
# the operator's connection is lost: dash leaves without EXIT's trap where a signal has none of its own.
if [ -n "$booted" ] && systemctl --quiet is-active rigcal.service; then
    echo "Stopping rigcal.service for the upgrade"
    trap 'systemctl start rigcal.service' EXIT
    trap 'exit 1' HUP INT TERM
    systemctl stop rigcal.service
fi

"$here/bootstrap.sh" /opt/rigcal/venv "$here/../requirements.lock"
ln -sfn /opt/rigcal/venv/bin/rigcal /usr/local/bin/rigcal
complete bash /usr/local/share/bash-completion/completions/rigcal
complete zsh /usr/local/share/zsh/site-functions/_rigcal
complete fish /usr/local/share/fish/vendor_completions.d/rigcal.fish
place_files
systemd-sysusers rigcal.conf
# As the service's user, whose cache it is; without it the first calibration would wait for the compiler.
echo "Compiling kernels ahead (half a minute)"
install -d -o rigcal -g rigcal -m 0750 /var/cache/rigcal
runuser -u rigcal -- env -i CACHE_DIRECTORY=/var/cache/rigcal /opt/rigcal/venv/bin/python -I -m daemon.warm_up ||
    echo "rigcal installation: compiling ahead failed; the first calibration compiles instead" >&2
if [ -n "$booted" ]; then
    systemctl daemon-reload
    systemctl restart systemd-modules-load.service systemd-sysctl.service
    udevadm control --reload
    udevadm trigger --subsystem-match=tty
    systemctl try-restart rigcal-web.service
fi

cat <<'NEXT'
rigcal is installed. Then, in this order (deploy/README.md says more):
  1. edit /etc/rigcal/rigcal.toml and check it:    rigcal config check /etc/rigcal/rigcal.toml
  2. edit /etc/udev/rules.d/99-rigcal-station.rules: the serial number of the station's adapter
  3. edit /etc/systemd/network/80-can0.network: the bus's bit rate;   systemctl enable --now systemd-networkd
  4. systemctl enable --now rigcal
  5. the operator's page, if it is wanted (docs/how-to/operator-page.md):    systemctl enable --now rigcal-web
NEXT
