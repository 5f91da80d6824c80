"""When should a robot ask, and when give back? Chapters 2 and 3, one gate a file, each usable as a priority by name."""

from tutelage.fleet.gates.always import DAgger
from tutelage.fleet.gates.base import Gate, GateConfig
from tutelage.fleet.gates.ensemble import EnsembleDAgger
from tutelage.fleet.gates.human import HGDAgger
from tutelage.fleet.gates.lazy import LazyDAgger
from tutelage.fleet.gates.safe import SafeDAgger
from tutelage.fleet.gates.thrifty import ThriftyDAgger

GATES: dict[str, type[Gate]] = {
    "DAgger": DAgger,
    "SafeDAgger": SafeDAgger,
    "EnsembleDAgger": EnsembleDAgger,
    "LazyDAgger": LazyDAgger,
    "ThriftyDAgger": ThriftyDAgger,
    "HG-DAgger": HGDAgger,
}

__all__ = [
    "GATES", "DAgger", "EnsembleDAgger", "Gate", "GateConfig", "HGDAgger", "LazyDAgger", "SafeDAgger", "ThriftyDAgger",
]  # fmt: skip
