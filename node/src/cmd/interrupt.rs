//! Ctrl-C and SIGTERM: the first one asks the run to stop and keep what it has, the second one ends the process as usual.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tracing::warn;

/// Exit code of a process that a second signal ended (128 + SIGINT, as shells have it).
const GIVEN_UP: i32 = 130;

/// A flag that is raised by Ctrl-C or SIGTERM. Without a way to listen for them, never raised.
pub fn stop_flag() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let raised = flag.clone();
    let (ready, listening) = std::sync::mpsc::sync_channel(1);
    std::thread::spawn(move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
        runtime.block_on(async {
            let Ok(mut signals) = Signals::new() else { return };
            // Nobody waits any more only where nobody ever did.
            let _ = ready.send(());
            if signals.next().await {
                warn!("stopping: what was done so far is being written; press Ctrl-C again to give up");
                raised.store(true, Ordering::Relaxed);
                if signals.next().await {
                    std::process::exit(GIVEN_UP);
                }
            }
        });
    });
    // From here on a signal is heard; fails only where there is nothing to listen with.
    let _ = listening.recv();
    flag
}

#[cfg(unix)]
struct Signals([tokio::signal::unix::Signal; 2]);

#[cfg(unix)]
impl Signals {
    fn new() -> std::io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self([signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?]))
    }

    /// True when one came, false when none can come any more.
    async fn next(&mut self) -> bool {
        use std::task::Poll;
        std::future::poll_fn(|context| {
            for signal in &mut self.0 {
                if let Poll::Ready(came) = signal.poll_recv(context) {
                    return Poll::Ready(came.is_some());
                }
            }
            Poll::Pending
        })
        .await
    }
}

#[cfg(not(unix))]
struct Signals;

#[cfg(not(unix))]
impl Signals {
    fn new() -> std::io::Result<Self> {
        Ok(Self)
    }

    async fn next(&mut self) -> bool {
        tokio::signal::ctrl_c().await.is_ok()
    }
}
