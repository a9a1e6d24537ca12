//! The named choices. The first of each is the authors' program, the second the paper or an option for small budgets.

use serde::{Deserialize, Serialize};

macro_rules! choice {
    ($(#[$meta:meta])* $name:ident { $($(#[$vmeta:meta])* $variant:ident),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum $name { #[default] $($(#[$vmeta])* $variant),+ }
    };
}

choice!(
    /// Velocities per Gaussian.
    VelocityKind {
        /// One signed velocity for both directions of time (authors).
        One,
        /// Six channels (paper eq. 1): `v-` first, `v+` last; `mean(t') = mean - (t'-t) v-` before, `mean + (t'-t) v+` after.
        ForwardBackward,
    }
);

choice!(
    /// Where the velocity bases of the motion tokens start from.
    VelocityBases {
        /// The decoder's output is the velocity (paper and authors).
        Learned,
        /// The decoder's output is added to a fixed fan of velocities, see [`spread_bases`]: an untrained network can then
        /// already learn which pixel moves how, instead of waiting for bases that differ. For small training budgets.
        Spread,
    }
);

/// The fan that [`VelocityBases::Spread`] starts from, m/s in the anchor's axes (x forward, y left, z up): along
/// and across the road, in pairs that cancel, so that equal weights mean standing still. The first is zero.
pub fn spread_bases(count: usize) -> Vec<[f32; 3]> {
    let pair = |k: usize| {
        let ring = (k / 3) as f32;
        match k % 3 {
            0 => [3.0 + 6.0 * ring, 0.0, 0.0],
            1 => [6.0 + 6.0 * ring, 0.0, 0.0],
            _ => [0.0, 4.0 + 4.0 * ring, 0.0],
        }
    };
    let mut bases = vec![[0.0; 3]; count];
    for (k, two) in bases.get_mut(1..).unwrap_or_default().chunks_exact_mut(2).enumerate() {
        two[0] = pair(k);
        two[1] = pair(k).map(|x| -x);
    }
    bases
}

choice!(
    /// What the depth channel measures.
    DepthMeaning {
        /// Depth along the optical axis: the ray has z = 1 (authors).
        ZDepth,
        /// Distance along the unit ray (paper).
        RayDistance,
    }
);

choice!(
    /// Raw depth channel to metres, with `s = sigmoid(x)`.
    DepthActivation {
        /// `near + s (far - near)` (paper and authors).
        Sigmoid,
        /// `near (far / near)^s`: equal relative steps, for small training budgets.
        Log,
    }
);

choice!(
    /// Where in pixel `j` its ray passes.
    RayPixelOffset {
        /// `j + 1.0`: the half pixel is added twice (authors; needed by their weights).
        DoubleHalf,
        /// `j + 0.5`: the pixel's centre, where the rasteriser has it.
        Half,
    }
);

choice!(
    /// Activation of the colour channels.
    ColorActivation {
        /// The raw value (authors).
        None,
        /// `2 sigmoid(x) - 1` (paper).
        TanhLike,
    }
);

choice!(
    /// What a colour is relative to.
    ColorBase {
        /// The activated value itself (paper and authors).
        Absolute,
        /// The input pixel plus the activated value, both in the network range -1..1.
        Residual,
    }
);

choice!(
    /// The sky head.
    SkyKind {
        /// Un-normalised direction in, width 512 (authors).
        Raw512,
        /// Frequency-encoded unit direction in (4 octaves of sine and cosine), width 64 (paper).
        Frequency64,
    }
);

choice!(
    /// What the 3 x 4 exposure matrix `A` of a camera does to a colour.
    AffineKind {
        /// Channel `p` times `sum_q A[p, q]`: the fourth column is a gain too (authors).
        Gain,
        /// `A[:, :3] colour + A[:, 3]` (paper).
        MatrixBias,
    }
);

choice!(
    /// The decoder of motion keys, queries and velocity bases.
    MaskDecoder {
        /// Layer norm after every doubling, MLP keys, two-layer queries, one shared basis MLP.
        Authors,
        /// No norm after the last doubling, linear keys, three-layer queries, one basis MLP per token.
        Paper,
    }
);

choice!(
    /// Which version's rules the rasteriser follows.
    GsplatConvention {
        /// The commit the authors pin (1.0.0).
        Pinned,
        /// The newest release.
        Latest,
    }
);
