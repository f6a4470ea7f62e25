"""The manifest of a run: what was asked, with which versions and inputs, and how it went."""

import hashlib
import json
import platform
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cosim.choices import Source
from cosim.config import Config
from results.codes import BASE_VARIANT, Role, labels
from results.tables import SCHEMA_VERSION

PACKAGES = ("cosim", "eclipse-sumo", "libsumo", "numpy", "scipy", "numba", "pyarrow", "pandas", "embreex")


def sha256(path: Path) -> str:
    """Checksum of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(slots=True)
class Manifest:
    """What `manifest.json` says; rewritten whole, so that it is never half there."""

    folder: Path
    config: Config
    net: dict[str, str]
    """Name, licence, attribution and checksums of the network's files."""
    choices: dict[str, Source]
    """Which class every choice of the config is, with the file and checksum of a user's own."""
    steps: int = 0
    """Steps recorded so far."""
    timings_s: dict[str, float] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)

    def write(self, status: str) -> None:
        """Save with `status`: running, finished, interrupted or failed."""
        content = {
            "schema_version": SCHEMA_VERSION,
            "status": status,
            "dt_s": self.config.traffic.step_s,
            "steps": self.steps,
            "sense_every_steps": self.config.sense_every_steps,
            "seed": self.config.seed,
            "traffic_seed": self.config.traffic.seed,
            "variants": [BASE_VARIANT, *(variant.name for variant in self.config.trust_variant)],
            "roles": labels(Role),
            "config": self.config.to_dict(),
            "versions": {"python": platform.python_version()} | {p: version(p) for p in PACKAGES},
            "net": self.net,
            "choices": {key: asdict(source) for key, source in self.choices.items()},
            "timings_s": {stage: round(s, 3) for stage, s in self.timings_s.items()},
            "summary": self.summary,
        }
        partial = self.folder / "manifest.json.partial"
        partial.write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")
        partial.replace(self.folder / "manifest.json")
