"""Pictures with point clouds and maps: `cosim plot sweep`, `scene`, `movie`, `map` and `stale`.

Question: what did a vehicle see, and what did it believe, at this moment? For everybody who looks at a run. Tests:
`tests/addons/pictures`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    choices={
        "figure": {
            "map": "cosim.addons.pictures.map_figure:draw",
            "stale": "cosim.addons.pictures.stale_figure:draw",
        },
    },
    hooks={f"plot {name}": f"cosim.addons.pictures.pictures:{name}" for name in ("sweep", "scene", "movie")},
)
