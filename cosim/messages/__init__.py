"""Messages, the choice of objects in them, and the links to the trust server."""
