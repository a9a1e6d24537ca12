//! The methods that are compared, and their names.

/// One row of the tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// This network.
    Storm,
    /// This network with all velocities set to zero: what modelling motion is worth.
    Static,
    /// The network sees each timestep alone and nothing moves; the Gaussians of all timesteps together (GS-LRM's setting).
    PerFrame,
    /// The same, but each picture is drawn from the nearest timestep's Gaussians only.
    PerFrameNearest,
    /// Static Gaussians optimised on the window's pictures, from random points.
    Gs3d,
    /// The same, starting from this network's Gaussians.
    Gs3dInit,
    /// Scene flow fitted to the ground-truth points of each pair of timesteps; no pictures.
    Nsfp,
    /// Ground-truth geometry; every object moves with the velocity it had when first seen: the ceiling of a constant velocity.
    ConstantVelocity,
    /// Ground-truth geometry and flow as pixel-aligned Gaussians: the ceiling of the representation at this picture size.
    OracleGeometry,
    /// The nearest context picture of the same camera.
    NearestContext,
}

impl Method {
    /// All, in the order of the tables.
    pub const ALL: [Self; 10] = [
        Self::Storm,
        Self::Static,
        Self::PerFrame,
        Self::PerFrameNearest,
        Self::Gs3d,
        Self::Gs3dInit,
        Self::Nsfp,
        Self::ConstantVelocity,
        Self::OracleGeometry,
        Self::NearestContext,
    ];

    /// Its key in the JSON files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Storm => "storm",
            Self::Static => "static",
            Self::PerFrame => "per_frame",
            Self::PerFrameNearest => "per_frame_nearest",
            Self::Gs3d => "gs3d",
            Self::Gs3dInit => "gs3d_init",
            Self::Nsfp => "nsfp",
            Self::ConstantVelocity => "constant_velocity",
            Self::OracleGeometry => "oracle_geometry",
            Self::NearestContext => "nearest_context",
        }
    }

    /// Whether it takes seconds to minutes per clip instead of a few passes of the network.
    pub fn is_expensive(self) -> bool {
        matches!(self, Self::Gs3d | Self::Gs3dInit | Self::Nsfp)
    }

    /// Reads a list such as `storm,gs3d`; `cheap` and `all` stand for several. In table order, each once.
    ///
    /// # Errors
    /// The unknown name, with those there are.
    pub fn parse_list(text: &str) -> Result<Vec<Self>, String> {
        let mut wanted = Vec::new();
        for name in text.split(',').map(str::trim).filter(|n| !n.is_empty()) {
            match name {
                "all" => wanted.extend(Self::ALL),
                "cheap" => wanted.extend(Self::ALL.into_iter().filter(|m| !m.is_expensive())),
                _ => wanted.push(Self::ALL.into_iter().find(|m| m.name() == name).ok_or_else(|| unknown(name))?),
            }
        }
        let picked: Vec<Self> = Self::ALL.into_iter().filter(|m| wanted.contains(m)).collect();
        if picked.is_empty() { Err(unknown(text)) } else { Ok(picked) }
    }
}

fn unknown(name: &str) -> String {
    let names: Vec<&str> = Method::ALL.into_iter().map(Method::name).collect();
    format!("there is no method '{name}'; there are all, cheap, {}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_read_in_table_order() {
        assert_eq!(Method::parse_list("gs3d, storm,gs3d"), Ok(vec![Method::Storm, Method::Gs3d]));
        assert_eq!(Method::parse_list("all").unwrap().len(), Method::ALL.len());
        let cheap = Method::parse_list("cheap,nsfp").unwrap();
        assert!(cheap.contains(&Method::Nsfp) && !cheap.contains(&Method::Gs3d));
        assert!(Method::parse_list("storm,3dgs").unwrap_err().contains("'3dgs'"));
        assert!(Method::parse_list(" ,").is_err());
    }
}
