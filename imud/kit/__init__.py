"""Parts that more than one leaf needs: codec and driver contracts, sessions, tables, formats shared with clients."""
