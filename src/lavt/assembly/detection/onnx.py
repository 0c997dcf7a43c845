"""The construction of the detector `onnx` from its file."""

from __future__ import annotations

from pathlib import Path

from lavt.config.perception import NeuralNetworkConfig
from lavt.config_file import parse_config, read_yaml
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.detection import DetectorSettings
from lavt.perception.network_paint import NetworkInput, NetworkOutput, NetworkPaint


def build_network_paint(_camera: CalibratedCamera, settings: DetectorSettings) -> NetworkPaint:
    """Build a finder of paint from the file that the settings name; raise `UserError` if it cannot be used."""
    if not settings.file:
        raise UserError(
            "the detector onnx needs a file that describes the network: set perception.file, or --detector-file "
            "(docs/perception.md)"
        )
    path = Path(settings.file)
    config = parse_config(NeuralNetworkConfig, read_yaml(path), str(path))
    expected, output = config.input, config.output
    return NetworkPaint(
        path.parent / config.model,
        NetworkInput(
            expected.width_px,
            expected.height_px,
            expected.resize == "letterbox",
            expected.channels == "rgb",
            expected.scale,
            expected.mean,
            expected.deviation,
        ),
        NetworkOutput(output.name, tuple(name in output.paint for name in output.classes), output.threshold),
    )
