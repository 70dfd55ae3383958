#!/bin/sh
# In the guest: takes the command and the files from /ctl (a directory of the host), leaves there what came of it.
#   /ctl/command, /ctl/repo.tar, /ctl/overlay.tar (unpacked over /; optional), /ctl/interactive (optional)
#   -> /ctl/status, /ctl/journal.txt, and whatever the command writes to /ctl
stty -onlcr
modprobe -q 9pnet_virtio
mount -t 9p -o trans=virtio,version=9p2000.L,msize=524288,cache=mmap ctl /ctl || poweroff -ff
tar -xf /ctl/repo.tar -C /repo
[ ! -e /ctl/overlay.tar ] || tar -xf /ctl/overlay.tar -C / --no-same-owner --no-overwrite-dir

export HOME=/root LANG=C.UTF-8
# The package under test is the installed one, not the source tree one happens to stand in.
export PYTHONSAFEPATH=1
cd /repo || poweroff -ff
if [ -e /ctl/interactive ]; then
    TERM=xterm setsid -c -w bash /ctl/command
else
    TERM=dumb bash /ctl/command </dev/null
fi
echo $? > /ctl/status.new
journalctl -b --no-pager > /ctl/journal.txt 2>/dev/null
mv /ctl/status.new /ctl/status
sync
poweroff -ff >/dev/null 2>&1
