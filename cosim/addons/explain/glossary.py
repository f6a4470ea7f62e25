"""Technical terms as this project uses them, of `glossary.toml`; `dictionary.py` writes them into `TABLES.md`."""

import tomllib
from collections.abc import Mapping
from pathlib import Path

GLOSSARY: Mapping[str, str] = tomllib.loads(Path(__file__).with_name("glossary.toml").read_text(encoding="utf-8"))
