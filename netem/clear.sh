#!/bin/sh
# Restores an interface after server.sh, client.sh or `lavt netem apply`. Queued packets are lost;
# `lavt netem clear --interface IF` waits for them.
#
#     sudo sh netem/clear.sh IF                               sudo sh netem/clear.sh eth0
set -eu
tc qdisc show dev "$1" | grep -q '^qdisc prio 4c56: root' || { echo "$1 has no queue of LAVT" >&2; exit 1; }
tc qdisc del dev "$1" root
