//! Images of several cameras brought together around a reference stamp.
