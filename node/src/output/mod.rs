//! What a run leaves behind: PLY, CSV, TUM, MCAP, pictures and the report.
