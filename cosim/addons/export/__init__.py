"""A run in the layouts that other tools read; frames are converted here and nowhere else."""
