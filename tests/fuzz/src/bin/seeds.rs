//! Writes the seed corpora: `cargo run --bin seeds -- FOLDER` makes one folder per target.

fn main() -> std::io::Result<()> {
    let folder = std::path::PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| "corpus".into()));
    for (name, _, seeds) in storm_fuzz::TARGETS {
        let dir = folder.join(name);
        std::fs::create_dir_all(&dir)?;
        for (i, seed) in seeds().into_iter().enumerate() {
            std::fs::write(dir.join(format!("seed{i:02}")), seed)?;
        }
    }
    Ok(())
}
