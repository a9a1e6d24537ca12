//! Camera messages to pictures: raw encodings, compressed files, rectification.
