//! A meeting place of two threads that never makes the sender wait: per stream the newest messages, oldest given up first.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

#[derive(Debug)]
struct Stream<T> {
    items: VecDeque<(u64, T)>,
    capacity: usize,
    dropped: u64,
}

#[derive(Debug)]
struct State<T> {
    streams: Vec<Stream<T>>,
    arrivals: u64,
    closed: bool,
}

/// What waiting gave.
#[derive(Debug, PartialEq)]
pub enum Taken<T> {
    /// Messages, in the order they arrived over all streams.
    Some(Vec<T>),
    /// None within the time.
    Nothing,
    /// None, and there will be none.
    Closed,
}

/// Rings of messages, one per stream.
#[derive(Debug)]
pub struct Inbox<T> {
    state: Mutex<State<T>>,
    arrived: Condvar,
}

impl<T> Inbox<T> {
    /// One stream per capacity; a stream holds at least one message.
    pub fn new(capacities: &[usize]) -> Self {
        let stream = |&c: &usize| Stream { items: VecDeque::new(), capacity: c.max(1), dropped: 0 };
        let state = State { streams: capacities.iter().map(stream).collect(), arrivals: 0, closed: false };
        Self { state: Mutex::new(state), arrived: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State<T>> {
        // A thread that panicked elsewhere left the rings as they are: every change below is complete in itself.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts a message in; the stream's oldest goes, and is counted, when it is full. Never waits for the receiver. A
    /// message for a stream there is not, or after [`Inbox::close`], is dropped.
    pub fn push(&self, stream: usize, item: T) {
        let mut state = self.lock();
        if state.closed {
            return;
        }
        state.arrivals += 1;
        let number = state.arrivals;
        let Some(stream) = state.streams.get_mut(stream) else { return };
        if stream.items.len() >= stream.capacity {
            stream.items.pop_front();
            stream.dropped += 1;
        }
        stream.items.push_back((number, item));
        drop(state);
        self.arrived.notify_one();
    }

    /// Takes at most `most` messages, waiting up to `patience` for the first.
    pub fn take(&self, most: usize, patience: Duration) -> Taken<T> {
        let until = Instant::now() + patience;
        let mut state = self.lock();
        while state.streams.iter().all(|s| s.items.is_empty()) {
            if state.closed {
                return Taken::Closed;
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Taken::Nothing;
            }
            state = self.arrived.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        let mut taken = Vec::new();
        while taken.len() < most {
            let oldest = state.streams.iter_mut().min_by_key(|s| s.items.front().map_or(u64::MAX, |(n, _)| *n));
            let Some((_, item)) = oldest.and_then(|s| s.items.pop_front()) else { break };
            taken.push(item);
        }
        Taken::Some(taken)
    }

    /// Gives up all messages that wait, uncounted.
    pub fn clear(&self) {
        self.lock().streams.iter_mut().for_each(|s| s.items.clear());
    }

    /// No more messages are taken in; the receiver gets those that wait, then [`Taken::Closed`].
    pub fn close(&self) {
        self.lock().closed = true;
        self.arrived.notify_all();
    }

    /// Messages given up, by stream.
    pub fn dropped(&self) -> Vec<u64> {
        self.lock().streams.iter().map(|s| s.dropped).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn full_streams_give_up_their_oldest_and_the_order_is_that_of_arrival() {
        let inbox = Inbox::new(&[2, 3]);
        for (stream, item) in [(0, 1), (1, 2), (0, 3), (0, 4), (1, 5), (9, 6)] {
            inbox.push(stream, item);
        }
        assert_eq!(inbox.dropped(), [1, 0]);
        assert_eq!(inbox.take(3, Duration::ZERO), Taken::Some(vec![2, 3, 4]));
        assert_eq!(inbox.take(3, Duration::ZERO), Taken::Some(vec![5]));
        assert_eq!(inbox.take(3, Duration::ZERO), Taken::Nothing);
        inbox.push(0, 7);
        inbox.close();
        inbox.push(0, 8);
        assert_eq!(inbox.take(3, Duration::ZERO), Taken::Some(vec![7]));
        assert_eq!(inbox.take(3, Duration::from_secs(60)), Taken::Closed);
    }

    #[test]
    fn a_waiting_receiver_is_woken() {
        let inbox = Inbox::new(&[1]);
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| inbox.take(1, Duration::from_secs(60)));
            inbox.push(0, 5);
            assert_eq!(waiting.join().unwrap(), Taken::Some(vec![5]));
        });
    }

    proptest! {
        #[test]
        fn every_message_is_taken_or_counted(pushes in proptest::collection::vec(0usize..3, 0..60), most in 1usize..5) {
            let inbox = Inbox::new(&[1, 4, 9]);
            let mut taken = Vec::new();
            for (i, &stream) in pushes.iter().enumerate() {
                inbox.push(stream, i);
                if i % 7 == 0 && let Taken::Some(items) = inbox.take(most, Duration::ZERO) {
                    taken.extend(items);
                }
            }
            while let Taken::Some(items) = inbox.take(most, Duration::ZERO) {
                prop_assert!(items.windows(2).all(|w| w[0] < w[1]));
                taken.extend(items);
            }
            let dropped: u64 = inbox.dropped().iter().sum();
            prop_assert_eq!(taken.len() as u64 + dropped, pushes.len() as u64);
        }
    }
}
