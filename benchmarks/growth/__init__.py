"""How campaigns and logs grow, and what interruptions leave of them."""
