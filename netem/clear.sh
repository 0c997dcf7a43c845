#!/bin/sh
# Puts an interface back that server.sh, client.sh or `lavt netem apply` has delayed. What is under way is lost;
# `lavt netem clear --interface IF` waits for it.
#
#     sudo sh netem/clear.sh IF                               sudo sh netem/clear.sh eth0
set -eu
tc qdisc show dev "$1" | grep -q '^qdisc prio 4c56: root' || { echo "$1 holds nothing of ours" >&2; exit 1; }
tc qdisc del dev "$1" root
