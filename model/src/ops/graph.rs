//! A node of candle's gradient graph with any number of inputs, whose gradients are not added to zeros.
//!
//! candle's custom operations take at most three tensors. A node here takes its first inputs directly and the others
//! through a *carrier*: a tensor of one zero whose own node holds the next inputs. The node computes all gradients at
//! once, hands out its own, and leaves the rest for the carriers, which candle visits later in the same pass. Only inputs
//! that are part of a graph take a place in it.
//!
//! candle adds every gradient it is given to zeros of the tensor's size. So the node, too, is a tensor of one zero, its
//! *root*, and the values are an operation on it. A node whose input is another node's result takes that node's root in its place:
//! candle is given a zero, the gradient itself waits in [`Gathered`] until candle visits the root, after all who add to it.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::ThreadId;

use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, DType, Device, Layout, Result, Shape, Tensor, TensorId, bail,
};

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

/// Whatever a thread that panicked left is sound: every change is one assignment.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What candle is given in place of a gradient.
fn nothing() -> Result<Tensor> {
    Tensor::zeros(1, DType::F32, &Device::Cpu)
}

/// The sum of a result's gradients so far, by the thread whose backward pass they belong to. A pass that ended in an error
/// leaves what it had: its graph is not to be gone through again by that thread.
#[derive(Default)]
struct Gathered(Mutex<Vec<(ThreadId, Tensor)>>);

impl Gathered {
    fn add(&self, gradient: Tensor) -> Result<()> {
        let thread = std::thread::current().id();
        let mut sums = lock(&self.0);
        match sums.iter_mut().find(|(owner, _)| *owner == thread) {
            Some((_, sum)) => *sum = sum.add(&gradient)?,
            None => sums.push((thread, gradient)),
        }
        Ok(())
    }

    fn take(&self) -> Option<Tensor> {
        let thread = std::thread::current().id();
        let mut sums = lock(&self.0);
        let at = sums.iter().position(|(owner, _)| *owner == thread)?;
        Some(sums.swap_remove(at).1)
    }
}

/// Where a result's gradients go.
#[derive(Clone)]
struct Root {
    tensor: Tensor,
    gathered: Arc<Gathered>,
}

/// The roots of results that are alive.
static ROOTS: LazyLock<Mutex<HashMap<TensorId, Root>>> = LazyLock::new(Mutex::default);

/// What a node and its carriers share.
struct Shared {
    backward: Box<dyn Backward>,
    gathered: Arc<Gathered>,
    /// The values, outside of the graph.
    result: OnceLock<Tensor>,
    /// Gradients on their way to the carriers, by the thread whose backward pass they belong to.
    waiting: Mutex<Vec<(ThreadId, Vec<Option<Tensor>>)>>,
}

impl Shared {
    fn gradients(&self) -> Result<Vec<Option<Tensor>>> {
        match (self.result.get(), self.gathered.take()) {
            (Some(result), Some(grad)) => self.backward.gradients(result, &grad),
            _ => bail!("{}: visited before its result", self.backward.name()),
        }
    }

    fn leave(&self, gradients: Vec<Option<Tensor>>) {
        let mut waiting = lock(&self.waiting);
        let thread = std::thread::current().id();
        // A pass that ended in an error may have left some.
        waiting.retain(|(owner, _)| *owner != thread);
        waiting.push((thread, gradients));
    }

    fn collect(&self) -> Result<Vec<Option<Tensor>>> {
        let mut waiting = lock(&self.waiting);
        let thread = std::thread::current().id();
        match waiting.iter().position(|(owner, _)| *owner == thread) {
            Some(at) => Ok(waiting.swap_remove(at).1),
            None => bail!("{}: a carrier was visited before its node", self.backward.name()),
        }
    }
}

/// One custom operation: a root or a carrier.
struct Link {
    shared: Arc<Shared>,
    /// Its direct inputs' places among all inputs; where their gradients go when they are other nodes' results.
    places: Vec<(usize, Option<Arc<Gathered>>)>,
    /// Whether its last argument is a carrier.
    carries: bool,
    is_root: bool,
}

impl Link {
    fn forward(&self) -> Result<(CpuStorage, Shape)> {
        Ok((CpuStorage::F32(vec![0.0]), Shape::from(1)))
    }

    fn backward<const N: usize>(&self) -> Result<[Option<Tensor>; N]> {
        let mut gradients = if self.is_root { self.shared.gradients()? } else { self.shared.collect()? };
        let mut out = [const { None }; N];
        for (to, (place, gathered)) in out.iter_mut().zip(&self.places) {
            *to = match (gradients.get_mut(*place).and_then(Option::take), gathered) {
                (Some(gradient), Some(gathered)) => {
                    gathered.add(gradient)?;
                    Some(nothing()?)
                }
                (gradient, _) => gradient,
            };
        }
        if self.carries {
            out[N - 1] = Some(nothing()?);
            self.shared.leave(gradients);
        }
        Ok(out)
    }
}

/// A result as an operation on its root.
struct Values {
    name: &'static str,
    gathered: Arc<Gathered>,
    /// Until candle asks for them.
    values: Mutex<Option<(Vec<f32>, Shape)>>,
    /// The result's, once there is one.
    id: Arc<OnceLock<TensorId>>,
}

impl CustomOp1 for Values {
    fn name(&self) -> &'static str {
        self.name
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        match lock(&self.values).take() {
            Some((values, shape)) => Ok((CpuStorage::F32(values), shape)),
            None => bail!("{}: evaluated twice", self.name),
        }
    }
    /// Of those who are no nodes.
    fn bwd(&self, _: &Tensor, _: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        self.gathered.add(grad.clone())?;
        nothing().map(Some)
    }
}

impl Drop for Values {
    fn drop(&mut self) {
        let root = self.id.get().and_then(|id| lock(&ROOTS).remove(id));
        // What hangs on it may come here again: not while the lock is held.
        drop(root);
    }
}

impl CustomOp1 for Link {
    fn name(&self) -> &'static str {
        self.shared.backward.name()
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.forward()
    }
    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor) -> Result<Option<Tensor>> {
        let [one] = self.backward()?;
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
    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor, _: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [one, two] = self.backward()?;
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
        _: &Tensor,
        _: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [one, two, three] = self.backward()?;
        Ok((one, two, three))
    }
}

/// An input that is tracked: its place among all, what stands for it in the graph, and where its gradient goes if not there.
type Input = (usize, Tensor, Option<Arc<Gathered>>);

/// The tensor of `values`, in the graph behind those of `inputs` that are tracked.
pub(super) fn node(
    values: Vec<f32>,
    shape: impl Into<Shape>,
    inputs: &[Option<&Tensor>],
    backward: impl Backward,
) -> Result<Tensor> {
    let shape = shape.into();
    let name = backward.name();
    if shape.elem_count() != values.len() {
        bail!("{name}: {} values for {shape:?}", values.len());
    }
    let tracked = inputs.iter().enumerate().filter_map(|(place, input)| Some((place, (*input)?)));
    let tracked: Vec<Input> = tracked
        .filter(|(_, input)| input.track_op())
        .map(|(place, input)| match lock(&ROOTS).get(&input.id()).cloned() {
            Some(Root { tensor, gathered }) => (place, tensor, Some(gathered)),
            None => (place, input.clone(), None),
        })
        .collect();
    if tracked.is_empty() {
        return Tensor::from_vec(values, shape, &Device::Cpu);
    }
    let gathered = Arc::<Gathered>::default();
    let shared = Arc::new(Shared {
        backward: Box::new(backward),
        gathered: Arc::clone(&gathered),
        result: OnceLock::new(),
        waiting: Mutex::default(),
    });
    let root = link(&shared, &tracked, true)?;
    let id = Arc::<OnceLock<TensorId>>::default();
    let values = Mutex::new(Some((values, shape)));
    let result = root.apply_op1(Values { name, gathered: Arc::clone(&gathered), values, id: Arc::clone(&id) })?;
    // Not with its graph: that holds the root, and the root this.
    let _ = shared.result.set(result.detach());
    let _ = id.set(result.id());
    lock(&ROOTS).insert(result.id(), Root { tensor: root, gathered });
    Ok(result)
}

fn link(shared: &Arc<Shared>, inputs: &[Input], is_root: bool) -> Result<Tensor> {
    let direct = if inputs.len() > DIRECT { DIRECT - 1 } else { inputs.len() };
    let (direct, rest) = inputs.split_at(direct);
    let carrier = match rest {
        [] => None,
        rest => Some(link(shared, rest, false)?),
    };
    let link = Link {
        shared: Arc::clone(shared),
        places: direct.iter().map(|(place, _, gathered)| (*place, gathered.clone())).collect(),
        carries: carrier.is_some(),
        is_root,
    };
    let arguments: Vec<&Tensor> = direct.iter().map(|(_, input, _)| input).chain(&carrier).collect();
    match arguments[..] {
        [one] => one.apply_op1(link),
        [one, two] => one.apply_op2(two, link),
        [one, two, three] => one.apply_op3(two, three, link),
        _ => bail!("{}: {} arguments", link.shared.backward.name(), arguments.len()),
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Var;

    use super::*;

    struct Twice;

    impl Backward for Twice {
        fn name(&self) -> &'static str {
            "twice"
        }
        fn gradients(&self, _: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
            Ok(vec![Some((grad * 2.0)?)])
        }
    }

    fn twice(x: &Tensor) -> Tensor {
        let values = (x * 2.0).unwrap().to_vec1::<f32>().unwrap();
        node(values, x.dims(), &[Some(x)], Twice).unwrap()
    }

    #[test]
    fn gradients_of_nodes_and_of_others_are_added_and_dropped_results_leave_nothing() {
        let x = Var::new(&[1f32, -3.0], &Device::Cpu).unwrap();
        let y = twice(x.as_tensor());
        // Two nodes and one of candle's own operations read `y`: 2 (2 + 2 (2 + 2) + 1) = 22.
        let z = twice(&y);
        let sum = ((twice(&(&z + &z).unwrap()) + twice(&y)).unwrap() + &y).unwrap();
        for _ in 0..2 {
            let grads = sum.backward().unwrap();
            assert_eq!(grads.get(x.as_tensor()).unwrap().to_vec1::<f32>().unwrap(), [22.0, 22.0]);
        }
        let ids = [y.id(), z.id()];
        assert!(ids.iter().all(|id| lock(&ROOTS).contains_key(id)));
        drop((y, z, sum));
        assert!(ids.iter().all(|id| !lock(&ROOTS).contains_key(id)));
    }
}
