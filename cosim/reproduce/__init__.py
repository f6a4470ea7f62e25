"""The paper, played again: its scenarios and its quantitative experiments, expected beside obtained."""
