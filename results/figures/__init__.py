"""Pictures for papers, each drawn from one run or several."""
