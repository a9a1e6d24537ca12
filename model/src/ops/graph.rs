//! A node of candle's gradient graph with any number of inputs.
//!
//! candle's custom operations take at most three tensors. A node here takes its first inputs directly and the others
//! through a *carrier*: a tensor of one zero whose own node holds the next inputs. The node computes all gradients at
//! once, hands out its own, and leaves the rest for the carriers, which candle visits later in the same pass. Only inputs
//! that are part of a graph take a place in it.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::ThreadId;

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, Device, Layout, Result, Shape, Tensor, bail};

/// Inputs of one of candle's custom operations.
const DIRECT: usize = 3;

/// How a result depends on its inputs. Whatever the derivative needs (inputs, stored sums) is kept in the value itself.
pub(super) trait Backward: Send + Sync + 'static {
    /// The operation's name, for candle's messages.
    fn name(&self) -> &'static str;
    /// The gradients of the inputs given to [`node`], in that order, from the gradient of `result`. Those of inputs that
    /// are not tracked are never read.
    fn gradients(&self, result: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>>;
}

/// What a node and its carriers share.
struct Shared {
    backward: Box<dyn Backward>,
    /// Gradients on their way to the carriers, by the thread whose backward pass they belong to.
    waiting: Mutex<Vec<(ThreadId, Vec<Option<Tensor>>)>>,
}

impl Shared {
    fn leave(&self, gradients: Vec<Option<Tensor>>) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let thread = std::thread::current().id();
        // A pass that ended in an error may have left some.
        waiting.retain(|(owner, _)| *owner != thread);
        waiting.push((thread, gradients));
    }

    fn collect(&self) -> Result<Vec<Option<Tensor>>> {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let thread = std::thread::current().id();
        match waiting.iter().position(|(owner, _)| *owner == thread) {
            Some(at) => Ok(waiting.swap_remove(at).1),
            None => bail!("{}: a carrier was visited before its node", self.backward.name()),
        }
    }
}

/// One custom operation: the node itself or a carrier.
struct Link {
    shared: Arc<Shared>,
    /// Places of its direct inputs among all inputs.
    places: Vec<usize>,
    /// Whether its last argument is a carrier.
    carries: bool,
    is_node: bool,
    /// The values, until candle asks for them.
    values: Mutex<Option<(Vec<f32>, Shape)>>,
}

impl Link {
    fn forward(&self) -> Result<(CpuStorage, Shape)> {
        match self.values.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some((values, shape)) => Ok((CpuStorage::F32(values), shape)),
            None => bail!("{}: evaluated twice", self.shared.backward.name()),
        }
    }

    fn backward<const N: usize>(&self, result: &Tensor, grad: &Tensor) -> Result<[Option<Tensor>; N]> {
        let mut gradients =
            if self.is_node { self.shared.backward.gradients(result, grad)? } else { self.shared.collect()? };
        let mut out = [const { None }; N];
        for (to, &place) in out.iter_mut().zip(&self.places) {
            *to = gradients.get_mut(place).and_then(Option::take);
        }
        if self.carries {
            out[N - 1] = Some(Tensor::zeros(1, candle_core::DType::F32, &Device::Cpu)?);
            self.shared.leave(gradients);
        }
        Ok(out)
    }
}

impl CustomOp1 for Link {
    fn name(&self) -> &'static str {
        self.shared.backward.name()
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.forward()
    }
    fn bwd(&self, _: &Tensor, result: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let [one] = self.backward(result, grad)?;
        Ok(one)
    }
}

impl CustomOp2 for Link {
    fn name(&self) -> &'static str {
        self.shared.backward.name()
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.forward()
    }
    fn bwd(&self, _: &Tensor, _: &Tensor, result: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [one, two] = self.backward(result, grad)?;
        Ok((one, two))
    }
}

impl CustomOp3 for Link {
    fn name(&self) -> &'static str {
        self.shared.backward.name()
    }
    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.forward()
    }
    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        result: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [one, two, three] = self.backward(result, grad)?;
        Ok((one, two, three))
    }
}

/// The tensor of `values`, in the graph behind those of `inputs` that are tracked.
pub(super) fn node(
    values: Vec<f32>,
    shape: impl Into<Shape>,
    inputs: &[Option<&Tensor>],
    backward: impl Backward,
) -> Result<Tensor> {
    let tracked = inputs.iter().enumerate().filter_map(|(place, input)| Some((place, (*input)?)));
    let tracked: Vec<(usize, &Tensor)> = tracked.filter(|(_, input)| input.track_op()).collect();
    let shared = Arc::new(Shared { backward: Box::new(backward), waiting: Mutex::default() });
    let shape = shape.into();
    if shape.elem_count() != values.len() {
        bail!("{}: {} values for {shape:?}", shared.backward.name(), values.len());
    }
    if tracked.is_empty() {
        return Tensor::from_vec(values, shape, &Device::Cpu);
    }
    link(&shared, &tracked, true, (values, shape))
}

fn link(shared: &Arc<Shared>, inputs: &[(usize, &Tensor)], is_node: bool, values: (Vec<f32>, Shape)) -> Result<Tensor> {
    let direct = if inputs.len() > DIRECT { DIRECT - 1 } else { inputs.len() };
    let (direct, rest) = inputs.split_at(direct);
    let carrier = match rest {
        [] => None,
        rest => Some(link(shared, rest, false, (vec![0.0], Shape::from(1)))?),
    };
    let link = Link {
        shared: Arc::clone(shared),
        places: direct.iter().map(|(place, _)| *place).collect(),
        carries: carrier.is_some(),
        is_node,
        values: Mutex::new(Some(values)),
    };
    let arguments: Vec<&Tensor> = direct.iter().map(|(_, input)| *input).chain(&carrier).collect();
    match arguments[..] {
        [one] => one.apply_op1(link),
        [one, two] => one.apply_op2(two, link),
        [one, two, three] => one.apply_op3(two, three, link),
        _ => bail!("{}: {} arguments", link.shared.backward.name(), arguments.len()),
    }
}
