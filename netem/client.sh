#!/bin/sh
# Delays the control on the client's machine, as `lavt netem apply CONDITION --role client --interface IF` does.
#
#     sudo sh netem/client.sh IF CONTROL_MS [ROUTER_PORT]     sudo sh netem/client.sh eth0 75
#
# IF          the interface that faces the server
# CONTROL_MS  for how long what goes to the server's router (UDP) is held
# It begins with a free interface: clear it first with netem/clear.sh. What each word means: docs/netem.md.
set -eu
interface=$1 control_ms=$2 router_port=${3:-7448}
trap '[ $? = 0 ] || tc qdisc del dev "$interface" root handle 4c56: 2>/dev/null' EXIT

# Six bands: everything goes through the first three as before, filters alone lead to the others.
tc qdisc add dev "$interface" root handle 4c56: prio bands 6

# The fifth band holds what comes. A rate makes netem keep order; this one costs a packet a microsecond.
tc qdisc add dev "$interface" parent 4c56:5 handle 4c02: netem limit 10000 delay "${control_ms}ms" rate 10gbit

# To the router's port, whole packets.
tc filter add dev "$interface" parent 4c56: protocol ip prio 3 u32 match u8 0x45 0xff at 0 \
    match u16 0x0000 0x1fff at 6 match ip protocol 17 0xff match ip dport "$router_port" 0xffff classid 4c56:5
tc filter add dev "$interface" parent 4c56: protocol ipv6 prio 4 u32 match ip6 protocol 17 0xff \
    match ip6 dport "$router_port" 0xffff classid 4c56:5
