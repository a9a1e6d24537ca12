//! Ctrl-C: the first one asks the run to stop and keep what it has, the second one ends the process as usual.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tracing::warn;

/// A flag that is raised by Ctrl-C. Without a way to listen for it (no signal handling on this system), never raised.
pub fn stop_flag() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let raised = flag.clone();
    std::thread::spawn(move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
        if runtime.block_on(tokio::signal::ctrl_c()).is_err() {
            return;
        }
        warn!("stopping: what was read so far is being written; press Ctrl-C again to give up");
        raised.store(true, Ordering::Relaxed);
        if runtime.block_on(tokio::signal::ctrl_c()).is_ok() {
            std::process::exit(130);
        }
    });
    flag
}
