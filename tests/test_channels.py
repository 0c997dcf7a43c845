from __future__ import annotations

import ast
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import pytest

import lavt.nodes
from lavt.assembly.entropy import SeededEntropy
from lavt.assembly.nodes import build_client, build_server
from lavt.channels import CHANNELS, QUEUE_LENGTH
from lavt.config import ClientCameraConfig, ClientConfig, ServerCameraConfig, ServerConfig, VehicleConfig
from lavt.domain import Now
from lavt.node import WAKE, Node

OUTSIDE_OF_THE_NODES = {"clock_source", "injector", "operator", "runtime"}


@pytest.fixture(scope="module")
def nodes() -> Sequence[Node]:
    """All nodes of both sides, as they are built for a run."""
    camera = ServerCameraConfig(width_px=640, height_px=480)
    server = build_server(
        ServerConfig(vehicle=VehicleConfig(scenery="none"), camera=camera),
        lambda: Now(0, 10**18),
        SeededEntropy(1, "server"),
        host="",
        video_port=1,
    )
    client = build_client(
        ClientConfig(camera=ClientCameraConfig(width_px=640, height_px=480)),
        lambda: Now(0, 10**18),
        SeededEntropy(1, "client"),
    )
    return [*server.all, *client.all]


PART_OF = {"picture_reader": "driver"}
"""Modules of which a node is made."""


def sent_channels() -> set[tuple[str, str]]:
    """Read from the nodes' source what they send: (module, channel)."""
    found = set()
    for path in Path(str(lavt.nodes.__file__)).parent.glob("*.py"):
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Send":
                channel = call.args[0]
                assert isinstance(channel, ast.Constant), f"{path.name}:{call.lineno} sends on a channel without a name"
                found.add((PART_OF.get(path.stem, path.stem), str(channel.value)))
    return found


def test_what_nodes_listen_to(nodes: Sequence[Node]) -> None:
    """Nodes listen to the channels that name them as receivers in the table, and to no others."""
    listened = {(channel, node.name) for node in nodes for channel in node.chains if channel != WAKE}
    assert listened == {(channel, name) for channel, row in CHANNELS.items() for name in row.receivers}


def test_every_chain_has_named_stages(nodes: Sequence[Node]) -> None:
    """A chain has at least one hop, and its hops have different names: the timeline tells them apart by these."""
    for node in nodes:
        for stages in node.chains.values():
            names = [name for name, _ in stages]
            assert names
            assert len(set(names)) == len(names)


def test_what_nodes_send(nodes: Sequence[Node]) -> None:
    """What a node sends goes over a channel of the table; where somebody listens, the table names it as the sender."""
    sent = sent_channels()
    assert {channel for _, channel in sent} <= CHANNELS.keys()
    heard = {(module, channel) for module, channel in sent if CHANNELS[channel].carrier != "record"}
    names = {node.name for node in nodes}
    assert heard == {
        (row.sender, name) for name, row in CHANNELS.items() if row.sender in names and row.carrier != "record"
    }


def test_table_names_nodes(nodes: Sequence[Node]) -> None:
    """Senders and receivers in the table are names of nodes, of the runtime, of the source of time or of a person."""
    names = {node.name for node in nodes}
    assert {row.sender for row in CHANNELS.values()} <= names | OUTSIDE_OF_THE_NODES
    assert set(chain.from_iterable(row.receivers for row in CHANNELS.values())) == names


def test_everything_but_records_is_heard() -> None:
    """A channel has a receiver unless it is written down only, or is for the host's clock or queues."""
    deaf = {name for name, row in CHANNELS.items() if not row.receivers}
    assert deaf == {name for name, row in CHANNELS.items() if row.carrier == "record"} | {"clock_query", "inject"}


def test_ground_truth_stays_on_the_server() -> None:
    """What only a simulator knows crosses no network and reaches no node."""
    assert CHANNELS["truth"].carrier == "record"
    assert CHANNELS["truth"].receivers == ()


def test_commands_wait_in_order() -> None:
    """Every command is admitted or refused by itself: commands queue, and the queue is bounded."""
    assert CHANNELS["control"].waiting == "queue"
    assert 0 < QUEUE_LENGTH < 100_000
