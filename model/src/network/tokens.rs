//! Which tokens a forward pass with [`Shortcuts`] computes, which of them are taken as one, and how they come back.

use candle_core::{Device, Result, Tensor};

use super::shortcuts::Shortcuts;

/// Patches a merged cell is wide and high.
const CELL: usize = 2;

/// Rows that are taken as one.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Groups {
    /// The group of each row.
    of: Vec<u32>,
    /// The row's part of its group's mean.
    share: Vec<f32>,
    /// Patches each group stands for.
    pub sizes: Vec<f32>,
}

impl Groups {
    /// Rows with the same key are one group, numbered in the order of their first rows; rows without a key are alone. Row `i`
    /// stands for `sizes[i]` patches.
    fn new<K: Ord + Copy>(keys: &[Option<K>], sizes: &[f32]) -> Self {
        let mut known = std::collections::BTreeMap::new();
        let mut totals: Vec<f32> = Vec::new();
        let of: Vec<u32> = keys
            .iter()
            .zip(sizes)
            .map(|(key, &size)| {
                let next = totals.len();
                let group = key.map_or(next, |key| *known.entry(key).or_insert(next));
                if group == next {
                    totals.push(0.0);
                }
                totals[group] += size;
                group as u32
            })
            .collect();
        let share = of.iter().zip(sizes).map(|(&group, &size)| size / totals[group as usize]).collect();
        Self { of, share, sizes: totals }
    }

    /// Means of the groups of `x` `(b, rows, d)`: `(b, groups, d)`.
    pub fn mean(&self, x: &Tensor) -> Result<Tensor> {
        let (b, rows, d) = x.dims3()?;
        let share = Tensor::from_slice(&self.share, (1, rows, 1), x.device())?.to_dtype(x.dtype())?;
        let zeros = Tensor::zeros((b, self.sizes.len(), d), x.dtype(), x.device())?;
        zeros.index_add(&indices(&self.of, x.device())?, &x.broadcast_mul(&share)?, 1)
    }
}

/// Rows of `x` `(b, rows, d)` by number.
pub(crate) fn select(x: &Tensor, rows: &[u32]) -> Result<Tensor> {
    x.contiguous()?.index_select(&indices(rows, x.device())?, 1)
}

fn indices(rows: &[u32], device: &Device) -> Result<Tensor> {
    Tensor::from_slice(rows, rows.len(), device)
}

/// Where the patches of a window are: timesteps, cameras, rows and columns of patches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Grid {
    pub timesteps: usize,
    pub cameras: usize,
    pub rows: usize,
    pub cols: usize,
}

impl Grid {
    pub fn patches(&self) -> usize {
        self.timesteps * self.cameras * self.rows * self.cols
    }

    /// Picture, row and column of a patch.
    fn place(&self, patch: usize) -> (usize, usize, usize) {
        (patch / (self.rows * self.cols), patch / self.cols % self.rows, patch % self.cols)
    }

    /// The block of `side x side` patches of one picture a patch is in.
    fn cell(&self, patch: usize, side: usize) -> (usize, usize, usize) {
        let (picture, row, col) = self.place(patch);
        (picture, row / side, col / side)
    }
}

/// One window's tokens: `[those that are no patches | patches]`.
#[derive(Debug)]
pub(crate) struct TokenPlan {
    /// Tokens of the input that are computed; none: all.
    kept: Option<Vec<u32>>,
    /// Of those, which are taken as one.
    merged: Option<Groups>,
    /// Of the tokens then, which keys and values are taken as one in the middle blocks.
    pub pooled: Option<Groups>,
    /// Of the tokens then, the queries of the last block; none: all.
    pub last_queries: Option<Vec<u32>>,
    /// The row of each patch among the tokens in the blocks; none: it is not computed.
    group_of_patch: Vec<Option<u32>>,
    /// Where each token of the output comes from: a row of the last block's result; none: was not computed.
    back: Vec<Option<Return>>,
}

/// One token's way back.
#[derive(Debug, Clone, Copy)]
struct Return {
    /// Row of the last block's result.
    row: u32,
    /// Row of the computed tokens before merging, and of those after it.
    own: u32,
    group: u32,
}

/// What [`TokenPlan::finish`] needs of the input.
pub(crate) struct Entered {
    /// What goes into the blocks.
    pub tokens: Tensor,
    before_merging: Option<Tensor>,
}

impl TokenPlan {
    /// For windows of `extra` tokens that are no patches and then those of `grid`. `activity` says how much happens in each
    /// cell of [`CELL`] patches a side, in the order (picture, row, column), rounded up; asked for when tokens are merged.
    pub fn new(shortcuts: &Shortcuts, grid: Grid, extra: usize, activity: Option<&[f32]>) -> Self {
        let patches = grid.patches();
        // Computed tokens as patches.
        let computed: Vec<usize> = match &shortcuts.keep {
            Some(keep) => (0..patches).filter(|&i| keep.get(i).copied().unwrap_or(true)).collect(),
            None => (0..patches).collect(),
        };
        let kept = (computed.len() < patches)
            .then(|| (0..extra).chain(computed.iter().map(|i| extra + i)).map(|i| i as u32).collect());
        let merged = activity.and_then(|activity| merge(shortcuts.merge, grid, extra, &computed, activity));

        // After merging: the first patch of each token, and how many it stands for.
        let (first, sizes) = match &merged {
            Some(groups) => {
                let mut first: Vec<Option<usize>> = vec![None; groups.sizes.len()];
                for (patch, &group) in computed.iter().zip(&groups.of[extra..]) {
                    first[group as usize].get_or_insert(*patch);
                }
                (first, groups.sizes.clone())
            }
            None => {
                let first = std::iter::repeat_n(None, extra).chain(computed.iter().copied().map(Some));
                (first.collect(), vec![1.0; extra + computed.len()])
            }
        };
        let pooled = (shortcuts.kv_pool > 1).then(|| {
            let keys: Vec<_> = first.iter().map(|p| p.map(|p| grid.cell(p, shortcuts.kv_pool))).collect();
            Groups::new(&keys, &sizes)
        });
        let newest = (grid.timesteps - 1) * grid.cameras;
        let of_output = |patch: usize| !shortcuts.newest_only || grid.place(patch).0 >= newest;
        let last_queries: Option<Vec<u32>> = (shortcuts.newest_only && grid.timesteps > 1).then(|| {
            let wanted = |(i, p): (usize, &Option<usize>)| p.is_none_or(of_output).then_some(i as u32);
            first.iter().enumerate().filter_map(wanted).collect()
        });

        // Rows of the result by token.
        let mut rows = vec![None; first.len()];
        match &last_queries {
            Some(queries) => queries.iter().enumerate().for_each(|(row, &i)| rows[i as usize] = Some(row as u32)),
            None => rows.iter_mut().enumerate().for_each(|(i, row)| *row = Some(i as u32)),
        }
        let returning = |own: usize| {
            let group = merged.as_ref().map_or(own as u32, |groups| groups.of[own]);
            rows[group as usize].map(|row| Return { row, own: own as u32, group })
        };
        let mut own_of_patch = vec![None; patches];
        computed.iter().enumerate().for_each(|(i, &patch)| own_of_patch[patch] = Some(extra + i));
        let group = |own: usize| merged.as_ref().map_or(own as u32, |groups| groups.of[own]);
        let group_of_patch = own_of_patch.iter().map(|own| own.map(group)).collect();
        let of_patches = (0..patches).filter(|&p| of_output(p)).map(|p| own_of_patch[p].and_then(returning));
        let back = (0..extra).map(returning).chain(of_patches).collect();
        Self { kept, merged, pooled, last_queries, group_of_patch, back }
    }

    /// Patches each token stands for, where that is not one for all.
    pub fn sizes(&self) -> Option<&[f32]> {
        self.merged.as_ref().map(|groups| &groups.sizes[..])
    }

    /// What goes into the blocks of the input `(b, tokens, d)`.
    pub fn enter(&self, tokens: Tensor) -> Result<Entered> {
        let tokens = match &self.kept {
            Some(kept) => select(&tokens, kept)?,
            None => tokens,
        };
        Ok(match &self.merged {
            Some(groups) => Entered { tokens: groups.mean(&tokens)?, before_merging: Some(tokens) },
            None => Entered { tokens, before_merging: None },
        })
    }

    /// The patches' rows of the tokens `x` in the blocks, `(b, patches, d)`: a merged token's for all it stands for, zeros for what
    /// is not computed.
    pub fn patches(&self, x: &Tensor, extra: usize) -> Result<Tensor> {
        if self.kept.is_none() && self.merged.is_none() {
            return x.narrow(1, extra, x.dim(1)? - extra)?.contiguous();
        }
        let (b, rows, d) = x.dims3()?;
        let x = Tensor::cat(&[x, &Tensor::zeros((b, 1, d), x.dtype(), x.device())?], 1)?;
        let of: Vec<u32> = self.group_of_patch.iter().map(|row| row.unwrap_or(rows as u32)).collect();
        select(&x, &of)
    }

    /// `x` with `(b, patches, d)` added to the patches' tokens; merged ones get the mean.
    pub fn add(&self, x: Tensor, patches: &Tensor, extra: usize) -> Result<Tensor> {
        let (b, _, d) = x.dims3()?;
        let none = Tensor::zeros((b, extra, d), x.dtype(), x.device())?;
        x + self.enter(Tensor::cat(&[&none, patches], 1)?)?.tokens
    }

    /// The last block's result as tokens of the output, `(b, tokens, d)`: a merged token gives what the blocks made of it to
    /// all it stands for, and each adds what it differed by before; zeros for what was not computed.
    pub fn finish(&self, result: Tensor, entered: &Entered) -> Result<Tensor> {
        if self.kept.is_none() && self.merged.is_none() {
            return Ok(result);
        }
        let take = |x: &Tensor, of: fn(&Return) -> u32| {
            let (b, rows, d) = x.dims3()?;
            // A row of zeros at the end.
            let x = Tensor::cat(&[x, &Tensor::zeros((b, 1, d), x.dtype(), x.device())?], 1)?;
            let rows: Vec<u32> = self.back.iter().map(|r| r.as_ref().map_or(rows as u32, of)).collect();
            select(&x, &rows)
        };
        let out = take(&result, |r| r.row)?;
        match &entered.before_merging {
            Some(before) => (out + take(before, |r| r.own)?)? - take(&entered.tokens, |r| r.group)?,
            None => Ok(out),
        }
    }
}

/// Cells whose patches become one token: those in which least happens, until so many tokens are gone.
fn merge(part: f32, grid: Grid, extra: usize, computed: &[usize], activity: &[f32]) -> Option<Groups> {
    let (across, down) = (grid.cols.div_ceil(CELL), grid.rows.div_ceil(CELL));
    let number = |patch: usize| {
        let (picture, row, col) = grid.cell(patch, CELL);
        (picture * down + row) * across + col
    };
    let mut members = vec![0usize; activity.len()];
    computed.iter().for_each(|&patch| members[number(patch)] += 1);
    let mut order: Vec<usize> = (0..activity.len()).filter(|&cell| members[cell] > 1).collect();
    order.sort_by(|&a, &b| activity[a].total_cmp(&activity[b]).then(a.cmp(&b)));
    let mut left = (part * computed.len() as f32) as usize;
    let mut chosen = vec![false; activity.len()];
    for cell in order {
        if members[cell] - 1 > left {
            break;
        }
        left -= members[cell] - 1;
        chosen[cell] = true;
    }
    let keys: Vec<Option<usize>> = std::iter::repeat_n(None, extra)
        .chain(computed.iter().map(|&patch| Some(number(patch)).filter(|&cell| chosen[cell])))
        .collect();
    chosen.contains(&true).then(|| Groups::new(&keys, &vec![1.0; keys.len()]))
}

/// How much happens in each cell of a window's pictures `(t, v, 3, h, w)`, in the order of [`TokenPlan::new`]: the standard
/// deviation of its colours, plus their mean difference to the same place at the neighbouring timesteps, whichever is more.
pub(crate) fn activity(image: &Tensor, patch: usize) -> Result<Vec<f32>> {
    let (t, v, c, h, w) = image.dims5()?;
    let values = image.to_dtype(candle_core::DType::F32)?.to_device(&Device::Cpu)?.flatten_all()?.to_vec1::<f32>()?;
    let side = CELL * patch;
    let (down, across) = (h.div_ceil(side), w.div_ceil(side));
    let picture = |t: usize, camera: usize| &values[(t * v + camera) * c * h * w..][..c * h * w];
    let mut out = Vec::with_capacity(t * v * down * across);
    for step in 0..t {
        for camera in 0..v {
            let own = picture(step, camera);
            let beside = [step.checked_sub(1), Some(step + 1).filter(|&s| s < t)];
            for cell in 0..down * across {
                let (row, col) = (cell / across * side, cell % across * side);
                let (height, width) = (side.min(h - row), side.min(w - col));
                let count = (height * width) as f32;
                let runs = || (0..c * height).map(|k| ((k / height) * h + row + k % height) * w + col);
                let mut spread = 0f32;
                for channel in 0..c {
                    let runs = runs().skip(channel * height).take(height);
                    let (sum, squares) = runs.fold((0f32, 0f32), |(sum, squares), at| {
                        own[at..at + width].iter().fold((sum, squares), |(s, q), x| (s + x, q + x * x))
                    });
                    spread += (squares / count - (sum / count).powi(2)).max(0.0);
                }
                let change = |other: &[f32]| {
                    let apart = |at: usize| -> f32 {
                        own[at..at + width].iter().zip(&other[at..at + width]).map(|(a, b)| (a - b).abs()).sum()
                    };
                    runs().map(apart).sum::<f32>() / (count * c as f32)
                };
                let changes = beside.into_iter().flatten().map(|other| change(picture(other, camera)));
                out.push((spread / c as f32).sqrt() + changes.fold(0.0, f32::max));
            }
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { timesteps: 2, cameras: 1, rows: 3, cols: 5 };

    fn numbers(x: &Tensor) -> Vec<f32> {
        x.flatten_all().unwrap().to_vec1().unwrap()
    }

    /// `(1, tokens, 2)`: the token's number and its square.
    fn tokens(extra: usize) -> Tensor {
        let n = extra + GRID.patches();
        let values: Vec<f32> = (0..n).flat_map(|i| [i as f32, (i * i) as f32]).collect();
        Tensor::from_vec(values, (1, n, 2), &Device::Cpu).unwrap()
    }

    #[test]
    fn nothing_asked_for_is_nothing_done() {
        let plan = TokenPlan::new(&Shortcuts::default(), GRID, 3, None);
        assert!(plan.pooled.is_none() && plan.last_queries.is_none() && plan.sizes().is_none());
        let x = tokens(3);
        let entered = plan.enter(x.clone()).unwrap();
        assert_eq!(numbers(&plan.finish(entered.tokens.clone(), &entered).unwrap()), numbers(&x));
    }

    #[test]
    fn pooling_takes_blocks_within_pictures() {
        let plan = TokenPlan::new(&Shortcuts { kv_pool: 2, ..Shortcuts::default() }, GRID, 3, None);
        let pooled = plan.pooled.unwrap();
        // 3 x 5 patches are 2 x 3 blocks, in each of two pictures.
        assert_eq!(pooled.sizes.len(), 3 + 2 * 6);
        assert_eq!(pooled.sizes[..9], [1.0, 1.0, 1.0, 4.0, 4.0, 2.0, 2.0, 2.0, 1.0]);
        let means = numbers(&pooled.mean(&tokens(3)).unwrap());
        // Patches 0, 1, 5, 6 of the first picture are tokens 3, 4, 8, 9.
        assert_eq!(means[6], 6.0);
        // And one timestep on, 15 tokens later.
        assert_eq!(means[2 * 9], 21.0);
    }

    #[test]
    fn dropped_tokens_come_back_as_zeros() {
        let keep: Vec<bool> = (0..GRID.patches()).map(|i| i % 3 != 0).collect();
        let shortcuts = Shortcuts { keep: Some(keep.clone()), kv_pool: 2, ..Shortcuts::default() };
        let plan = TokenPlan::new(&shortcuts, GRID, 2, None);
        let x = tokens(2);
        let entered = plan.enter(x.clone()).unwrap();
        assert_eq!(entered.tokens.dim(1).unwrap(), 22);
        assert_eq!(plan.pooled.as_ref().unwrap().sizes.iter().sum::<f32>(), 22.0);
        let back = numbers(&plan.finish(entered.tokens.clone(), &entered).unwrap());
        for (i, row) in back.chunks_exact(2).enumerate() {
            let there = i < 2 || keep[i - 2];
            assert_eq!(row[0], if there { i as f32 } else { 0.0 }, "token {i}");
        }
    }

    #[test]
    fn merged_tokens_keep_what_they_differ_by() {
        let mut activity = vec![1.0; 12];
        activity[0] = 0.1;
        activity[7] = 0.2;
        // Room for six tokens less: two cells of four.
        let shortcuts = Shortcuts { merge: 0.2, ..Shortcuts::default() };
        let plan = TokenPlan::new(&shortcuts, GRID, 1, Some(&activity));
        let x = tokens(1);
        let entered = plan.enter(x.clone()).unwrap();
        assert_eq!(entered.tokens.dim(1).unwrap(), 31 - 6);
        assert_eq!(plan.sizes().unwrap().iter().filter(|&&s| s == 4.0).count(), 2);
        // Blocks that do nothing give back the input.
        let same = numbers(&plan.finish(entered.tokens.clone(), &entered).unwrap());
        let far = same.iter().zip(numbers(&x)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(far < 1e-3, "{far}");
        // Blocks that add one to a token add it to all it stands for.
        let more = numbers(&plan.finish((&entered.tokens + 1.0).unwrap(), &entered).unwrap());
        assert!(more.iter().zip(&same).all(|(a, b)| (a - b - 1.0).abs() < 1e-3));
        assert!(TokenPlan::new(&Shortcuts::default(), GRID, 1, None).sizes().is_none());
    }

    #[test]
    fn the_newest_timestep_alone() {
        for (shortcuts, activity) in [
            (Shortcuts { newest_only: true, ..Shortcuts::default() }, None),
            (Shortcuts { newest_only: true, merge: 0.2, ..Shortcuts::default() }, Some(vec![1.0; 12])),
        ] {
            let plan = TokenPlan::new(&shortcuts, GRID, 2, activity.as_deref());
            let x = tokens(2);
            let entered = plan.enter(x.clone()).unwrap();
            let queries = plan.last_queries.as_ref().unwrap();
            let last = select(&entered.tokens, queries).unwrap();
            let back = numbers(&plan.finish(last, &entered).unwrap());
            assert_eq!(back.len(), 2 * (2 + 15));
            for (i, row) in back.chunks_exact(2).enumerate() {
                let want = if i < 2 { i } else { i + 15 };
                assert!((row[0] - want as f32).abs() < 1e-3, "{i}: {}", row[0]);
            }
        }
    }

    #[test]
    fn flat_and_still_cells_are_merged_first() {
        // Two timesteps of one camera, 2 x 2 cells of 4 x 4 pixels: an edge in cell 1, a change in cell 2.
        let mut values = vec![0.3f32; 2 * 3 * 8 * 8];
        for c in 0..3 {
            for t in 0..2 {
                for row in 0..4 {
                    values[((t * 3 + c) * 8 + row) * 8 + 5] = -0.9;
                }
            }
            for row in 4..8 {
                for col in 0..4 {
                    values[((3 + c) * 8 + row) * 8 + col] = 0.5;
                }
            }
        }
        let image = Tensor::from_vec(values, (2, 1, 3, 8, 8), &Device::Cpu).unwrap();
        let activity = activity(&image, 2).unwrap();
        assert_eq!(activity.len(), 8);
        for picture in activity.chunks_exact(4) {
            assert!(picture[0] < 1e-3 && picture[3] < 1e-3, "{picture:?}");
            assert!(picture[1] > 0.1 && (picture[2] - 0.2).abs() < 1e-3, "{picture:?}");
        }
    }
}
