"""Commands on recordings: their replay, and what is in them."""
