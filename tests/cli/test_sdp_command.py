from __future__ import annotations

import pytest
from tests.support.command_line import Run

from lavt.config_file import shipped

SERVER = str(shipped("configs/server.yaml"))
ONE = "video.send_to=['192.0.2.7:5004']"
TWO = "video.send_to=['192.0.2.7:5004', '192.0.2.8:5006']"


def test_the_only_receiver(run: Run) -> None:
    """With one receiver in the config its description goes to standard output, and nothing else."""
    code, out, err = run("sdp", SERVER, "--set", ONE, "--set", "camera.width_px=1280", "--set", "camera.height_px=720")
    assert (code, err) == (0, "")
    lines = out.split("\r\n")
    assert lines[0] == "v=0"
    assert "c=IN IP4 192.0.2.7" in lines
    assert "m=video 5004 RTP/AVP 96" in lines
    assert "a=fmtp:96 packetization-mode=1;profile-level-id=42C01F" in lines  # level 3.1, for this size
    assert lines[-1] == ""


def test_one_of_several(run: Run) -> None:
    """With several receivers the one that is asked for is described."""
    code, out, _ = run("sdp", SERVER, "--set", TWO, "--receiver", "192.0.2.8:5006")
    assert code == 0
    assert "c=IN IP4 192.0.2.8\r\n" in out
    assert "m=video 5006 " in out


REJECTED = {
    "none": (["--set", "video.send_to=[]"], "video.send_to"),
    "which": (["--set", TWO], "--receiver"),
    "another": (["--set", ONE, "--receiver", "192.0.2.7:5005"], "192.0.2.7:5005"),
    "no address": (["--set", ONE, "--receiver", "here"], "--receiver: 'here'"),
    "no address in the config": (["--set", "video.send_to=[here]"], "video.send_to: 'here'"),
    "no host": (["--set", f"video.send_to=['{'a' * 64}:5004']"], "a" * 64),
    "no port": (["--set", "video.send_to=['192.0.2.7:0']"], "port 0 of 192.0.2.7"),
    "no size": (["--set", ONE, "--set", "camera.width_px=641"], "641"),
}


@pytest.mark.parametrize("case", REJECTED)
def test_rejected(case: str, run: Run) -> None:
    """Without a receiver that is known and can be one, a sentence says what to do, and the exit code is 2."""
    arguments, said = REJECTED[case]
    assert said in run("sdp", SERVER, *arguments).rejected()
