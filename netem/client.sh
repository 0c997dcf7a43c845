#!/bin/sh
# Delays the control on the client's machine, as `lavt netem apply CONDITION --role client --interface IF` does.
#
#     sudo sh netem/client.sh IF CONTROL_MS [ROUTER_PORT]     sudo sh netem/client.sh eth0 75
#
# IF          the interface that faces the server
# CONTROL_MS  delay of packets to the server's router (UDP)
# The interface must have its default queue: clear it first with netem/clear.sh. See docs/netem.md.
set -eu
interface=$1 control_ms=$2 router_port=${3:-7448}
trap '[ $? = 0 ] || tc qdisc del dev "$interface" root handle 4c56: 2>/dev/null' EXIT

# Six bands: by default all traffic uses the first three; only filters send packets to the others.
tc qdisc add dev "$interface" root handle 4c56: prio bands 6

# The fifth band delays its packets. netem keeps packets in order only if it also limits the rate; this limit takes a
# microsecond per packet.
tc qdisc add dev "$interface" parent 4c56:5 handle 4c02: netem limit 10000 delay "${control_ms}ms" rate 10gbit

# Packets, but not fragments, to the router's port.
tc filter add dev "$interface" parent 4c56: protocol ip prio 3 u32 match u8 0x45 0xff at 0 \
    match u16 0x0000 0x1fff at 6 match ip protocol 17 0xff match ip dport "$router_port" 0xffff classid 4c56:5
tc filter add dev "$interface" parent 4c56: protocol ipv6 prio 4 u32 match ip6 protocol 17 0xff \
    match ip6 dport "$router_port" 0xffff classid 4c56:5
