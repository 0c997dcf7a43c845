#!/bin/sh
# Delays the video on the server's machine, as `lavt netem apply CONDITION --role server --interface IF` does.
#
#     sudo sh netem/server.sh IF VIDEO_MS [VIDEO_PORT]        sudo sh netem/server.sh eth0 150
#
# IF        the interface that faces the client
# VIDEO_MS  delay of RTP and sender reports
# The interface must have its default queue: clear it first with netem/clear.sh. See docs/netem.md.
set -eu
interface=$1 video_ms=$2 video_port=${3:-5600}
trap '[ $? = 0 ] || tc qdisc del dev "$interface" root handle 4c56: 2>/dev/null' EXIT

# Six bands: by default all traffic uses the first three; only filters send packets to the others.
tc qdisc add dev "$interface" root handle 4c56: prio bands 6

# The fourth band delays its packets. netem keeps packets in order only if it also limits the rate; this limit takes a
# microsecond per packet.
tc qdisc add dev "$interface" parent 4c56:4 handle 4c01: netem limit 10000 delay "${video_ms}ms" rate 10gbit

# Packets, but not fragments, from the video's port whose payload begins like RTP (version 2). The challenges of the path
# validation begin differently, so they are not delayed.
tc filter add dev "$interface" parent 4c56: protocol ip prio 1 u32 match u8 0x45 0xff at 0 \
    match u16 0x0000 0x1fff at 6 match ip protocol 17 0xff match ip sport "$video_port" 0xffff \
    match u8 0x80 0xc0 at 28 classid 4c56:4
tc filter add dev "$interface" parent 4c56: protocol ipv6 prio 2 u32 match ip6 protocol 17 0xff \
    match ip6 sport "$video_port" 0xffff match u8 0x80 0xc0 at 48 classid 4c56:4
