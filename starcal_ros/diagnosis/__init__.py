"""Why the images of a set match no star, and the alignment where none is given."""
