"""Scouting on a local network: a server answers only if its config says so."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("namespaces")

LIMIT_S = 240
SCRIPT = """
ip link set lo up && ip link add lan type veth peer name far && ip address add 192.0.2.7/24 dev lan || exit 3
ip link set lan up && ip link set far up && ip route add 224.0.0.0/4 dev lan || exit 3
serve() {
    "$PYTHON" -m lavt server --json --set "vehicle_id=$1" --set video.port=0 --set clock.probe_port=0 \
        --set vehicle.scenery=none --set clock.source=probe --set "zenoh={scouting: $3,
        router_settings: {listen: {endpoints: ['udp/0.0.0.0:$2?rel=1;mixed_rel=1']}}}" > "$1" 2> "$1.log" &
    servers="$servers $!"
}
trap 'kill $servers; wait' EXIT
serve car-1 7448 true
serve car-2 7449 false
until grep -q ready car-1 && grep -q ready car-2; do
    kill -0 $servers || exit 4
    sleep 0.1
done
"$PYTHON" -m lavt vehicles --scout --json
"$PYTHON" -m lavt vehicles 192.0.2.7:7449 --json
"""
"""A network of its own, a server that answers scouting, one that does not, and two searches."""


def test_a_server_answers_scouting_only_if_its_config_says_so(tmp_path: Path) -> None:
    """`lavt vehicles --scout` finds the server with `zenoh.scouting`, but not the other one, which has to be named."""
    searched = subprocess.run(
        ["unshare", "--net", "env", f"PYTHON={sys.executable}", "sh", "-c", SCRIPT],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert searched.returncode == 0, searched.stderr
    scouted, named = (json.loads(line)["vehicles"] for line in searched.stdout.splitlines())
    assert [(vehicle["vehicle"], vehicle["router"].partition("?")[0]) for vehicle in scouted] == [
        ("car-1", "udp/192.0.2.7:7448")
    ]
    assert [vehicle["vehicle"] for vehicle in named] == ["car-2"]
