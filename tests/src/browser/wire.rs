//! The pipes to the browser: commands and answers of its debugging protocol, JSON that ends in a zero
//! byte. Events are kept in the order in which they came.

use std::io::{BufRead, BufReader, Write};
use std::process::{ChildStdin, ChildStdout};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::LIMIT;

/// What may wait to be read; more than any page of ours says between two commands.
const WAITING_MAX: usize = 100_000;

/// Both directions, and the events that came meanwhile.
#[derive(Debug)]
pub(super) struct Wire {
    input: ChildStdin,
    messages: Receiver<Value>,
    events: Vec<Value>,
    next_id: u64,
}

impl Wire {
    pub(super) fn new(input: ChildStdin, output: ChildStdout) -> Self {
        let (sender, messages) = mpsc::sync_channel(WAITING_MAX);
        // Ends with the pipe, or when nobody listens any more.
        thread::spawn(move || {
            let mut output = BufReader::new(output);
            let mut bytes = Vec::new();
            while let Ok(1..) = output.read_until(0, &mut bytes) {
                bytes.pop();
                let parsed = serde_json::from_slice(&bytes);
                bytes.clear();
                if parsed.is_ok_and(|message: Value| sender.send(message).is_err()) {
                    return;
                }
            }
        });
        Self {
            input,
            messages,
            events: Vec::new(),
            next_id: 1,
        }
    }

    /// Sends a command without waiting; returns its number. A browser that is gone is noticed by
    /// whoever waits for an answer.
    pub(super) fn tell(&mut self, session: Option<&str>, method: &str, parameters: &Value) -> u64 {
        let id = self.next_id;
        self.next_id += 1;
        let mut message = json!({"id": id, "method": method, "params": parameters});
        if let Some(session) = session {
            message["sessionId"] = session.into();
        }
        let mut bytes = message.to_string().into_bytes();
        bytes.push(0);
        drop(self.input.write_all(&bytes));
        id
    }

    /// Sends a command and waits for its result.
    ///
    /// # Panics
    /// When the browser refuses, is gone or does not answer.
    pub(super) fn ask(&mut self, session: Option<&str>, method: &str, parameters: &Value) -> Value {
        let id = self.tell(session, method, parameters);
        let deadline = Instant::now() + LIMIT;
        loop {
            let Some(mut message) = self.next_by(deadline) else {
                panic!("the browser did not answer {method} within {LIMIT:?}");
            };
            if message["id"] != id {
                self.events.push(message);
                continue;
            }
            assert!(
                message.get("error").is_none(),
                "{method} {parameters}: {}",
                message["error"]
            );
            return message["result"].take();
        }
    }

    /// All events so far, the oldest first; each is handed out once.
    pub(super) fn take_events(&mut self) -> Vec<Value> {
        let now = Instant::now();
        while let Some(message) = self.next_by(now) {
            self.events.push(message);
        }
        std::mem::take(&mut self.events)
    }

    fn next_by(&self, deadline: Instant) -> Option<Value> {
        let left = deadline.saturating_duration_since(Instant::now());
        match self
            .messages
            .recv_timeout(left.max(Duration::from_millis(1)))
        {
            Ok(message) => Some(message),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => panic!("the browser is gone"),
        }
    }
}
