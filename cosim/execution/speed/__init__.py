"""What exists for speed and memory alone, and changes no result."""
