//! Which networks a grid has.

use super::super::Args;

/// The grids there are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum GridName {
    /// The paper's ablations (appendix, figures 8 and 9): velocity regulariser, motion tokens, timesteps, sky and affine
    /// tokens.
    Ablations,
    /// Picture size, width, depth, patch, and how colour, depth and velocity are predicted, with parameters and step times.
    Sizes,
}

impl GridName {
    /// Also the name of the files it leaves.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ablations => "ablations",
            Self::Sizes => "sizes",
        }
    }

    /// Its rows.
    pub fn rows(self) -> Vec<Row> {
        match self {
            Self::Ablations => ablations(),
            Self::Sizes => sizes(),
        }
    }
}

/// How a network differs from the one that the command's options alone would make.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Setting {
    /// Keys of its configuration, `KEY=VALUE`.
    pub network: Vec<String>,
    pub lambda_reg: Option<f64>,
    pub timesteps: Option<usize>,
}

impl Setting {
    fn network(keys: &[&str]) -> Self {
        Self { network: keys.iter().map(|k| (*k).to_owned()).collect(), ..Self::default() }
    }

    /// Folder of its files.
    pub fn folder(&self) -> String {
        let mut parts = self.network.clone();
        parts.extend(self.lambda_reg.map(|x| format!("lambda_reg={x:e}")));
        parts.extend(self.timesteps.map(|t| format!("timesteps={t}")));
        let plain = |c: char| if c.is_ascii_alphanumeric() || "=_-.,".contains(c) { c } else { '_' };
        if parts.is_empty() { "base".into() } else { parts.join(",").chars().map(plain).collect() }
    }

    /// The command's arguments with this setting's.
    pub fn args(&self, common: &Args) -> Args {
        let mut args = common.clone();
        args.variant.network.extend(self.network.iter().cloned());
        args.lambda_reg = self.lambda_reg.or(args.lambda_reg);
        args.variant.timesteps = self.timesteps.or(args.variant.timesteps);
        args.out = common.out.join(self.folder());
        args
    }
}

/// One row of the table: a network, seen with so many timesteps.
#[derive(Debug, Clone)]
pub struct Row {
    pub group: &'static str,
    pub label: String,
    pub setting: Setting,
    /// Timesteps of the clips it is scored on.
    pub seen: usize,
}

/// The paper's number of timesteps.
const TIMESTEPS: usize = 4;

/// The paper's network is the base of its ablations: regulariser 0.005, 16 motion tokens, 4 timesteps, all tokens.
fn ablations() -> Vec<Row> {
    let mut rows = Vec::new();
    let mut add = |group: &'static str, label: String, setting: Setting, seen: usize| {
        rows.push(Row { group, label, setting, seen });
    };
    for lambda_reg in [0.0, 5e-4, 5e-3, 5e-2] {
        let setting = Setting { lambda_reg: (lambda_reg != 5e-3).then_some(lambda_reg), ..Setting::default() };
        add("Velocity regulariser", format!("{lambda_reg}"), setting, TIMESTEPS);
    }
    for tokens in [0, 4, 8, 16, 32] {
        let key = format!("num_motion_tokens={tokens}");
        let setting = if tokens == 16 { Setting::default() } else { Setting::network(&[&key]) };
        add("Motion tokens", tokens.to_string(), setting, TIMESTEPS);
    }
    for seen in [1, 2, 4, 6] {
        add("Timesteps, trained with 4", seen.to_string(), Setting::default(), seen);
    }
    for timesteps in [1, 2, 4, 6] {
        let setting = Setting { timesteps: (timesteps != TIMESTEPS).then_some(timesteps), ..Setting::default() };
        add("Timesteps, retrained", timesteps.to_string(), setting, timesteps);
    }
    let (no_sky, no_affine) = ("use_sky_token=false", "use_affine_token=false");
    for (label, keys) in [
        ("sky and affine", &[][..]),
        ("no sky", &[no_sky]),
        ("no affine", &[no_affine]),
        ("neither", &[no_sky, no_affine]),
    ] {
        add("Tokens", label.into(), Setting::network(keys), TIMESTEPS);
    }
    rows
}

fn sizes() -> Vec<Row> {
    let rows: [(&'static str, &'static str, &[&str]); 13] = [
        ("tiny", "as it is", &[]),
        ("Picture", "96x48", &["image_height=48"]),
        ("Picture", "144x96", &["image_width=144", "image_height=96"]),
        ("Width", "128, 4 heads", &["embed_dim=128", "num_heads=4"]),
        ("Width", "256, 8 heads", &["embed_dim=256", "num_heads=8"]),
        ("Depth", "2 blocks", &["depth=2"]),
        ("Depth", "6 blocks", &["depth=6"]),
        ("Patch", "16: a quarter of the tokens", &["patch_size=16", "upsampler_widths=[192, 96, 64, 32]"]),
        ("Motion tokens", "8", &["num_motion_tokens=8"]),
        ("Colour", "predicted outright", &["color=absolute"]),
        ("Depth from", "sigmoid over near to far", &["depth_activation=sigmoid"]),
        ("Ray moments", "not scaled", &["ray_moment_scale=1"]),
        ("Velocity bases", "learned from nothing", &["velocity_bases=learned"]),
    ];
    let row = |(group, label, keys): &(&'static str, &str, &[&str])| {
        let label = (*label).to_owned();
        Row { group, label, setting: Setting::network(keys), seen: TIMESTEPS }
    };
    rows.iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use storm_model::ModelConfig;

    use super::*;

    fn settings(rows: &[Row]) -> Vec<Setting> {
        let mut settings: Vec<Setting> = Vec::new();
        rows.iter().for_each(|r| {
            if !settings.contains(&r.setting) {
                settings.push(r.setting.clone());
            }
        });
        settings
    }

    #[test]
    fn grids_have_the_papers_rows_and_folders_of_their_own() {
        for (name, rows, networks) in [(GridName::Ablations, 21, 14), (GridName::Sizes, 13, 13)] {
            let all = name.rows();
            let settings = settings(&all);
            assert_eq!((all.len(), settings.len()), (rows, networks));
            let mut folders: Vec<String> = settings.iter().map(Setting::folder).collect();
            folders.sort_unstable();
            folders.dedup();
            assert_eq!(folders.len(), settings.len());
            assert!(folders.contains(&"base".to_string()) && folders.iter().all(|f| !f.contains('/')), "{folders:?}");
        }
    }

    #[test]
    fn every_network_of_a_grid_can_be_made() {
        let tiny = ModelConfig::preset("tiny").unwrap();
        for row in GridName::Ablations.rows().into_iter().chain(GridName::Sizes.rows()) {
            let variant =
                super::super::super::VariantArgs { network: row.setting.network.clone(), ..Default::default() };
            variant.make(&tiny, 1, "tiny").unwrap_or_else(|e| panic!("{} {}: {e}", row.group, row.label));
        }
    }
}
