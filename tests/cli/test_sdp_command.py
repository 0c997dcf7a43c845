from __future__ import annotations

import pytest
from tests.support.command_line import Run

from lavt.config_file import shipped

SERVER = str(shipped("configs/server.yaml"))
ONE_RECEIVER = "video.send_to=['192.0.2.7:5004']"
TWO_RECEIVERS = "video.send_to=['192.0.2.7:5004', '192.0.2.8:5006']"


def test_the_only_receiver(run: Run) -> None:
    """With one receiver in the config, its session description is the only output."""
    code, out, err = run(
        "sdp", SERVER, "--set", ONE_RECEIVER, "--set", "camera.width_px=1280", "--set", "camera.height_px=720"
    )
    assert (code, err) == (0, "")
    lines = out.split("\r\n")
    assert lines[0] == "v=0"
    assert "c=IN IP4 192.0.2.7" in lines
    assert "m=video 5004 RTP/AVP 96" in lines
    assert "a=fmtp:96 packetization-mode=1;profile-level-id=42C01F" in lines  # level 3.1, for this size
    assert lines[-1] == ""


def test_one_of_several_receivers(run: Run) -> None:
    """With several receivers, the description is for the one that --receiver names."""
    code, out, _ = run("sdp", SERVER, "--set", TWO_RECEIVERS, "--receiver", "192.0.2.8:5006")
    assert code == 0
    assert "c=IN IP4 192.0.2.8\r\n" in out
    assert "m=video 5006 " in out


REJECTED = {
    "no receiver": (["--set", "video.send_to=[]"], "video.send_to"),
    "several receivers": (["--set", TWO_RECEIVERS], "--receiver"),
    "unknown receiver": (["--set", ONE_RECEIVER, "--receiver", "192.0.2.7:5005"], "192.0.2.7:5005"),
    "invalid address": (["--set", ONE_RECEIVER, "--receiver", "here"], "--receiver: 'here'"),
    "invalid address in the config": (["--set", "video.send_to=[here]"], "video.send_to: 'here'"),
    "unknown host": (["--set", f"video.send_to=['{'a' * 64}:5004']"], "a" * 64),
    "port 0": (["--set", "video.send_to=['192.0.2.7:0']"], "192.0.2.7"),
    "invalid size": (["--set", ONE_RECEIVER, "--set", "camera.width_px=641"], "641"),
}


@pytest.mark.parametrize("case", REJECTED)
def test_rejected(case: str, run: Run) -> None:
    """A missing, unknown or invalid receiver is rejected in one sentence with exit code 2."""
    arguments, reason = REJECTED[case]
    assert reason in run("sdp", SERVER, *arguments).rejection()
