from __future__ import annotations

import subprocess
import sys

import pytest

from lavt.config_file import shipped

SERVER = str(shipped("configs/server.yaml"))
ONE = "video.send_to=['192.0.2.7:5004']"
TWO = "video.send_to=['192.0.2.7:5004', '192.0.2.8:5006']"


def lavt_sdp(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    program = [sys.executable, "-m", "lavt", "sdp", *arguments]
    return subprocess.run(program, capture_output=True, timeout=60, check=False)


def test_the_only_receiver() -> None:
    """With one receiver in the config its description goes to standard output, and nothing else."""
    done = lavt_sdp(SERVER, "--set", ONE, "--set", "camera.width_px=1280", "--set", "camera.height_px=720")
    assert (done.returncode, done.stderr) == (0, b"")
    lines = done.stdout.split(b"\r\n")
    assert lines[0] == b"v=0"
    assert b"c=IN IP4 192.0.2.7" in lines
    assert b"m=video 5004 RTP/AVP 96" in lines
    assert b"a=fmtp:96 packetization-mode=1;profile-level-id=42C01F" in lines  # level 3.1, for this size
    assert lines[-1] == b""


def test_one_of_several() -> None:
    """With several receivers the one that is asked for is described."""
    done = lavt_sdp(SERVER, "--set", TWO, "--receiver", "192.0.2.8:5006")
    assert done.returncode == 0
    assert b"c=IN IP4 192.0.2.8\r\n" in done.stdout
    assert b"m=video 5006 " in done.stdout


REFUSED = {
    "none": (["--set", "video.send_to=[]"], "name one in video.send_to"),
    "which": (["--set", TWO], "choose one of them with --receiver"),
    "another": (["--set", ONE, "--receiver", "192.0.2.7:5005"], "no video is sent to 192.0.2.7:5005: add it"),
    "no address": (["--set", ONE, "--receiver", "here"], "--receiver: 'here' is not an address"),
    "no address in the config": (["--set", "video.send_to=[here]"], "video.send_to: 'here' is not an address"),
    "no host": (["--set", f"video.send_to=['{'a' * 64}:5004']"], "is not known"),
    "no port": (["--set", "video.send_to=['192.0.2.7:0']"], "port 0 of 192.0.2.7"),
    "no size": (["--set", ONE, "--set", "camera.width_px=641"], "641"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str) -> None:
    """Without a receiver that is known and can be one, a sentence says what to do, and the exit code is 2."""
    arguments, said = REFUSED[case]
    done = lavt_sdp(SERVER, *arguments)
    err = done.stderr.decode()
    assert (done.returncode, done.stdout, err.count("\n")) == (2, b"", 1), err
    assert said in err
