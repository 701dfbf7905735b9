#!/usr/bin/env bash
# vcan_guest.sh COMMAND [ARG...]: run a command where there are real SocketCAN interfaces vcan0 and vcan1.
#
# Many kernels, those of CI machines above all, have no CAN. User-mode Linux is a Linux kernel that runs as an ordinary program:
# Debian's package user-mode-linux brings one with the CAN modules. The guest's file system is the host's (hostfs, read-write, same
# paths), so that the checkout and its virtual environment are used as they are. Needs neither root nor /dev/kvm.
#
#   VCAN_GUEST_KERNEL   the guest's kernel; default: Debian's. uml_kernel.sh builds one that has virtual time.
#   VCAN_GUEST_TIME     "virtual": the clock jumps over the time in which nothing runs, and stands still while something does, so that
#                       what runs twice does so at the same times. It begins with the year 2020. What spins until some time has come,
#                       without asking for the time, spins for ever. Default: real time.
#   VCAN_GUEST_LIMIT_S  longest time that the command may take, by the machine's own clock; default: 300.
# Exit status: the command's; 125 when the guest did not run it.
set -u
LIMIT_S=${VCAN_GUEST_LIMIT_S:-300}
KERNEL=${VCAN_GUEST_KERNEL:-$(command -v linux.uml)} ||
  { echo "vcan_guest: no linux.uml; on Debian: apt-get install user-mode-linux" >&2; exit 125; }
case ${VCAN_GUEST_TIME-} in
  "") TIME=();;
  virtual)
    TIME=(time-travel=inf-cpu time-travel-start=1577836800000000000)      # ns
    "$KERNEL" --help | grep -q '^time-travel' || { echo "vcan_guest: $KERNEL has no virtual time" >&2; exit 125; };;
  *) echo "vcan_guest: VCAN_GUEST_TIME=$VCAN_GUEST_TIME: expected virtual, or nothing" >&2; exit 125;;
esac
MODULES=/usr/lib/uml/modules/$("$KERNEL" --version)/kernel
WORK=$(mktemp -d) || exit 125
trap 'rm -rf "$WORK"' EXIT

{ export -p; printf 'cd %q\nexec' "$PWD"; printf ' %q' "$@"; echo; } > "$WORK/command"

cat > "$WORK/init" <<'INIT'
#!/bin/bash
# First process of the guest. guest_work and guest_modules come from the kernel command line.
export XILGATE_VCAN_GUEST=1      # for tests: here everything is there, and what is missing is a failure
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
mount -t proc proc /proc; mount -t sysfs sys /sys
mount -t tmpfs run /run; mkdir -p /dev/shm /dev/pts; mount -t tmpfs shm /dev/shm -o mode=1777; mount -t devpts pts /dev/pts
ln -s /proc/self/fd /dev/fd 2>/dev/null
if [ ! -e /sys/module/vcan ]; then      # not built in
  for module in net/can/can net/can/can-raw drivers/net/can/dev/can-dev drivers/net/can/vcan drivers/net/can/slcan/slcan; do
    insmod "$guest_modules/$module.ko"
  done
fi
ip link set lo up
for interface in vcan0 vcan1; do ip link add $interface type vcan && ip link set $interface up || missing=$interface; done
stty -F /dev/tty0 raw -echo
mkfifo /run/output; cat /run/output > /dev/tty0 & reader=$!      # not a terminal, for what the command prints
if [ -n "${missing-}" ]; then
  echo "vcan_guest: no $missing in the guest" > /run/output; status=125
else
  setsid bash "$guest_work/command" < /dev/null > /run/output 2>&1; status=$?
fi
for _ in {1..40}; do kill -0 $reader 2>/dev/null || break; sleep 0.05; done
echo $status > "$guest_work/status"
sync; echo o > /proc/sysrq-trigger; sleep 9
INIT
chmod 700 "$WORK/init"

mkfifo "$WORK/console"; cat < "$WORK/console" & READER=$!
mkdir "$WORK/uml"
# Unpinned, a system call of the guest costs two to three times as much.
PIN=(taskset -c "$(($(nproc) - 1))")
# Where permitted, ahead of the host's other work, so that processes that drive a car are not held up; -R: the guest's kernel alone.
# In virtual time nothing is held up.
[ ${#TIME[@]} -eq 0 ] && chrt -R -f 20 true 2> /dev/null && PIN+=(chrt -R -f 20)
TMPDIR=$WORK timeout -k 3 "$LIMIT_S" "${PIN[@]}" "$KERNEL" mem=2G root=/dev/root rootfstype=hostfs rootflags=/ rw init="$WORK/init" \
  guest_work="$WORK" guest_modules="$MODULES" "${TIME[@]}" \
  uml_dir="$WORK/uml/" quiet con=null con0=null,fd:3 con1=null con2=null,fd:4 console=tty2 ssl=null \
  < /dev/null 3> "$WORK/console" 4> "$WORK/kernel.log" > "$WORK/boot.log" 2>&1
wait $READER
[ -s "$WORK/status" ] && exit "$(cat "$WORK/status")"
echo "vcan_guest: the guest did not finish within $LIMIT_S s or did not start:" >&2
tail -n 20 "$WORK/boot.log" "$WORK/kernel.log" >&2
exit 125
