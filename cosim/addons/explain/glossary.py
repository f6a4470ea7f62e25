"""Technical terms as this project uses them, of `glossary.toml`; `dictionary.py` writes them into `TABLES.md`."""

import tomllib
from collections.abc import Mapping
from pathlib import Path

_FILE = Path(__file__).with_name("glossary.toml")
GLOSSARY: Mapping[str, str] = tomllib.loads(_FILE.read_text(encoding="utf-8"))
