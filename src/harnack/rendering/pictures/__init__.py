"""From scenes to pictures: pixels, what they show, and the files they are written to."""
