"""What a run logs, shown elsewhere: in TensorBoard, W&B, trackio and MLflow."""

from pacesetter.tracking.numbers import numbers
from pacesetter.tracking.sinks import SINKS
from pacesetter.tracking.tracked import NONE, chosen, tracked

__all__ = ["NONE", "SINKS", "chosen", "numbers", "tracked"]
