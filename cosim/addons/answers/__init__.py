"""What a study answers, in sentences with intervals: the beginning of `cosim report STUDY`.

Question: how long do vehicles meet, and how old is the trust that they use, by the keys that I swept? For everybody who
has run a study. Tests: `tests/addons/answers`.
"""

from cosim.base.addons import Addon

ADDON = Addon(choices={"answer": {"core": "cosim.addons.answers.answers:sentences"}})
