"""Numbers as colours, and the bars that explain them."""
