#!/usr/bin/env bash
# uml_kernel.sh: print the path of a User-mode Linux kernel with SocketCAN built in and with virtual time; build it if there is none yet.
#
# Debian's own kernel of that kind lacks CONFIG_UML_TIME_TRAVEL_SUPPORT, with which the guest's clock jumps over idle time. The source is
# Debian's package linux-source, as installed or downloaded. The kernel is kept in the user's cache, by version of the source, options and
# steps. A build takes some seven minutes of processor time, JOBS (default 1) compilers at once.
# Exit status: 0, or 1 with the reason on standard error.
set -euo pipefail
TOOLS="bc bison flex gcc make xz"
PACKAGES="bc bison flex gcc libc6-dev make xz-utils"
OPTIONS=(64BIT MULTIUSER PRINTK BUG SYSFS PROC_FS PROC_SYSCTL SYSCTL FUTEX EPOLL EVENTFD SIGNALFD TIMERFD SHMEM AIO ADVISE_SYSCALLS
    MEMBARRIER POSIX_TIMERS POSIX_MQUEUE SYSVIPC FILE_LOCKING FHANDLE INOTIFY_USER BINFMT_ELF BINFMT_SCRIPT BLOCK
    HIGH_RES_TIMERS NO_HZ_IDLE CC_OPTIMIZE_FOR_PERFORMANCE TTY UNIX98_PTYS MCONSOLE MAGIC_SYSRQ STDERR_CONSOLE SSL NULL_CHAN
    HOSTFS TMPFS DEVTMPFS DEVTMPFS_MOUNT HW_RANDOM UML_RANDOM UML_TIME_TRAVEL_SUPPORT
    NET PACKET UNIX INET IPV6 NETDEVICES NET_CORE CAN CAN_RAW CAN_DEV CAN_NETLINK CAN_VCAN CAN_SLCAN)

fail() {
    echo "uml_kernel: $*" >&2
    exit 1
}

build() {
    cd "$work"
    if [ ! -e "$source" ]; then
        apt-get download "$package=$version"
        dpkg-deb --extract "$package"_*.deb .
        source=$work$source
    fi
    tar --extract --file "$source"
    cd linux-source-*/
    make -s ARCH=um KCONFIG_ALLCONFIG=/dev/null allnoconfig
    for option in "${OPTIONS[@]}"; do
        scripts/config --enable "$option"
    done
    make -s ARCH=um olddefconfig
    for option in "${OPTIONS[@]}"; do
        grep "^CONFIG_$option=y" .config || { echo "this kernel has no option $option"; return 1; }
    done
    make -s ARCH=um -j"${JOBS:-1}" linux
    strip -o "$work/linux" linux
    mv "$work/linux" "$kernel"
}

missing=()
for tool in $TOOLS; do
    command -v "$tool" > /dev/null || missing+=("$tool")
done
[ ${#missing[@]} -eq 0 ] || fail "missing: ${missing[*]}; on Debian: apt-get install $PACKAGES"
known=$(apt-cache --no-all-versions show linux-source 2> /dev/null) ||
    fail "apt does not know the package linux-source, Debian's; there: apt-get update"
package=$(sed -n 's/^Depends: .*\(linux-source-[0-9.]*\).*/\1/p' <<< "$known")
version=$(sed -n 's/^Version: //p' <<< "$known")
source=/usr/src/$package.tar.xz
[ ! -e "$source" ] || version=$(dpkg-query --show --showformat='${Version}' "$package")
content=$({ declare -f build; echo "${OPTIONS[@]}"; } | sha256sum)
directory=${XDG_CACHE_HOME:-$HOME/.cache}/xilgate/uml
kernel=$directory/linux-$version-${content:0:12}
if [ ! -x "$kernel" ]; then
    mkdir -p "$directory"
    work=$(mktemp -d "$directory/build.XXXXXX")
    trap 'rm -rf "$work"' EXIT
    set +e
    (set -e; build) > "$work/log" 2>&1
    status=$?
    set -e
    if [ $status -ne 0 ]; then
        tail -n 20 "$work/log" >&2
        fail "cannot build $kernel; on Debian it needs: apt-get install $PACKAGES $package"
    fi
fi
echo "$kernel"
