"""Episodes played side by side, what drives them, and the time they take: the floor of the other rooms."""
