"""Pictures with point clouds and with the map of a city: `cosim plot sweep`, `scene` and `movie`.

Question: what did a vehicle see, and what did it believe, at this moment? For everybody who looks at a run. Tests:
`tests/addons/pictures`.
"""

from cosim.base.addons import Addon

ADDON = Addon(
    hooks={f"plot {name}": f"cosim.addons.pictures.pictures:{name}" for name in ("sweep", "scene", "movie")},
)
