"""What vehicles say, who hears it, and who lies."""
