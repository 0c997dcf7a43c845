"""Tests of `CHANNELS`, the table of all channels."""

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
from lavt.config import (
    AGENT,
    HUMAN,
    ClientCameraConfig,
    ClientConfig,
    ControllerConfig,
    ServerCameraConfig,
    ServerConfig,
    VehicleConfig,
)
from lavt.domain import Now
from lavt.node import WAKE, Node

EXTERNAL_SENDERS = {"agent", "clock_source", "console", "injector", "operator", "runtime"}
"""The senders in the table that are no nodes."""


@pytest.fixture(scope="module")
def nodes() -> Sequence[Node]:
    """Return all nodes of both sides, built as for a run, and those of clients with other drivers or with a watcher."""
    camera = ServerCameraConfig(width_px=640, height_px=480)
    server = build_server(
        ServerConfig(vehicle=VehicleConfig(scenery="none"), camera=camera),
        lambda: Now(0, 10**18),
        SeededEntropy(1, "server"),
        host="",
        video_port=1,
    )
    clients = [
        build_client(
            ClientConfig(
                camera=ClientCameraConfig(width_px=640, height_px=480), controller=ControllerConfig(kind=controller)
            ),
            lambda: Now(0, 10**18),
            SeededEntropy(1, "client"),
            is_watched=controller != HUMAN,
        )
        for controller in ("lane_keeper", HUMAN, AGENT)
    ]
    return [*server.all, *(node for client in clients for node in client.all)]


NODE_OF_MODULE = {
    "picture_reader": "driver",
    "commander": "driver",
    "human_driver": "driver",
    "agent_driver": "driver",
}
"""The nodes of the modules that are not named after their node."""


def sent_channels() -> set[tuple[str, str]]:
    """Return (node, channel) of each `Send` in the source of the nodes."""
    found = set()
    for path in Path(str(lavt.nodes.__file__)).parent.glob("*.py"):
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Send":
                channel = call.args[0]
                assert isinstance(channel, ast.Constant), (
                    f"{path.name}:{call.lineno} sends on a channel that is not a constant"
                )
                found.add((NODE_OF_MODULE.get(path.stem, path.stem), str(channel.value)))
    return found


def test_nodes_receive_the_channels_of_the_table(nodes: Sequence[Node]) -> None:
    """Nodes receive exactly the channels that list them as receivers or observers."""
    received = {(channel, node.name) for node in nodes for channel in node.pipelines if channel != WAKE}
    assert received == {
        (channel, name) for channel, row in CHANNELS.items() for name in (*row.receivers, *row.observers)
    }


def test_stages_have_different_names(nodes: Sequence[Node]) -> None:
    """Each pipeline has at least one stage, and its stages have different names."""
    for node in nodes:
        for stages in node.pipelines.values():
            names = [name for name, _ in stages]
            assert names
            assert len(set(names)) == len(names)


def test_nodes_send_on_the_channels_of_the_table(nodes: Sequence[Node]) -> None:
    """Nodes send on channels of the table only, and the table names them as senders."""
    sent = sent_channels()
    assert {channel for _, channel in sent} <= CHANNELS.keys()
    not_only_recorded = {(node, channel) for node, channel in sent if CHANNELS[channel].carrier != "record"}
    names = {node.name for node in nodes}
    assert not_only_recorded == {
        (row.sender, name) for name, row in CHANNELS.items() if row.sender in names and row.carrier != "record"
    }


def test_senders_and_receivers_exist(nodes: Sequence[Node]) -> None:
    """Senders and receivers in the table are nodes, the runtime, a clock source, an injector or the operator."""
    names = {node.name for node in nodes}
    assert {row.sender for row in CHANNELS.values()} <= names | EXTERNAL_SENDERS
    assert set(chain.from_iterable(row.receivers for row in CHANNELS.values())) == names


def test_channels_without_receivers() -> None:
    """Every channel has a receiver, except for those that are only recorded, and those to parts that are no nodes."""
    without_receivers = {name for name, row in CHANNELS.items() if not row.receivers}
    assert without_receivers == {name for name, row in CHANNELS.items() if row.carrier == "record"} | {
        "clock_query",
        "inject",
        "page_status",
        "page_unit",
        "relay_delay",
        "watch_status",
        "watch_unit",
    }


def test_a_watching_page_reaches_no_other_node() -> None:
    """The node of pages that watch sends to pages only, and observes no channel whose messages run inline."""
    sent = {name: row for name, row in CHANNELS.items() if row.sender == "page_watch"}
    assert {(row.carrier, row.receivers, row.observers) for row in sent.values()} == {("console", (), ())}
    from_pages = {"watch_opened", "watch_closed", "watch_message"}
    assert {CHANNELS[name].receivers for name in from_pages} == {("page_watch",)}
    assert not any(row.inline for row in CHANNELS.values() if row.observers)


def test_ground_truth_stays_on_the_server() -> None:
    """Ground truth is recorded only; it crosses no network and reaches no node."""
    assert CHANNELS["truth"].carrier == "record"
    assert CHANNELS["truth"].receivers == CHANNELS["truth"].observers == ()


def test_commands_wait_in_a_bounded_queue() -> None:
    """Commands wait in a queue of bounded length, because the gate judges each command."""
    assert CHANNELS["control"].waiting == "queue"
    assert 0 < QUEUE_LENGTH < 100_000
