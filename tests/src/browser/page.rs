//! One page of a browser: where it goes, what a user does to it, what it shows, says and asks for.

use std::path::Path;
use std::time::{Duration, Instant};
use std::{fs, thread};

use serde_json::{Value, json};

use super::LIMIT;
use super::wire::Wire;
use crate::trial::load_average;

const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// A page with its size. Dropping it closes it.
#[derive(Debug)]
pub struct Page<'a> {
    wire: &'a mut Wire,
    target: String,
    session: String,
    complaints: Vec<String>,
    addresses: Vec<String>,
    received_bytes: u64,
    is_loaded: bool,
}

impl<'a> Page<'a> {
    pub(super) fn open(wire: &'a mut Wire, width: u32, height: u32) -> Self {
        let created = wire.ask(None, "Target.createTarget", &json!({"url": "about:blank"}));
        let target = text(&created["targetId"]);
        let attach = json!({"targetId": target, "flatten": true});
        let attached = wire.ask(None, "Target.attachToTarget", &attach);
        let mut page = Self {
            wire,
            target,
            session: text(&attached["sessionId"]),
            complaints: Vec::new(),
            addresses: Vec::new(),
            received_bytes: 0,
            is_loaded: false,
        };
        for domain in ["Page", "Runtime", "Log", "Network"] {
            page.ask(&format!("{domain}.enable"), &json!({}));
        }
        page.set_size(width, height);
        page
    }

    fn ask(&mut self, method: &str, parameters: &Value) -> Value {
        self.wire.ask(Some(&self.session), method, parameters)
    }

    /// Changes its size, in CSS pixels. Narrow ones are phones, with a finer screen.
    pub fn set_size(&mut self, width: u32, height: u32) {
        let is_phone = width < 600;
        let scale = if is_phone { 2 } else { 1 };
        let size = json!({"width": width, "height": height, "deviceScaleFactor": scale, "mobile": is_phone});
        self.ask("Emulation.setDeviceMetricsOverride", &size);
    }

    /// Says that the system wants dark colours, or light ones.
    pub fn set_dark(&mut self, is_dark: bool) {
        let value = if is_dark { "dark" } else { "light" };
        let media = json!({"features": [{"name": "prefers-color-scheme", "value": value}]});
        self.ask("Emulation.setEmulatedMedia", &media);
    }

    /// Lays the page out as for paper, or for the screen again; nothing is printed.
    pub fn set_paper(&mut self, is_paper: bool) {
        let media = if is_paper { "print" } else { "" };
        self.ask("Emulation.setEmulatedMedia", &json!({"media": media}));
    }

    /// Prints the page, as PDF.
    ///
    /// # Panics
    /// When it cannot be printed.
    pub fn printed(&mut self) -> Vec<u8> {
        let printed = self.ask("Page.printToPDF", &json!({}));
        let bytes = decoded(printed["data"].as_str().unwrap_or_default());
        assert!(bytes.starts_with(b"%PDF"), "nothing was printed");
        bytes
    }

    /// Goes to an address and waits until the page and what it names are loaded.
    ///
    /// # Panics
    /// When it cannot be reached or is not loaded in time.
    pub fn go(&mut self, address: &str) {
        self.is_loaded = false;
        let gone = self.ask("Page.navigate", &json!({"url": address}));
        assert!(gone.get("errorText").is_none(), "{address}: {gone}");
        let deadline = Instant::now() + LIMIT;
        while !self.is_loaded {
            assert!(
                Instant::now() < deadline,
                "{address}: not loaded within {LIMIT:?}; load {}",
                load_average()
            );
            self.listen();
        }
    }

    /// What an expression is on the page, as JSON; promises are awaited.
    ///
    /// # Panics
    /// When it throws.
    pub fn value(&mut self, expression: &str) -> Value {
        let wanted = json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let mut found = self.ask("Runtime.evaluate", &wanted);
        let thrown = found.get("exceptionDetails");
        assert!(thrown.is_none(), "{expression}: {found}");
        found["result"]["value"].take()
    }

    /// The text of the first element that a selector names.
    ///
    /// # Panics
    /// When there is none.
    pub fn text(&mut self, selector: &str) -> String {
        let found = self.value(&format!(
            "document.querySelector({selector:?})?.textContent"
        ));
        let Some(found) = found.as_str() else {
            panic!("no element {selector}");
        };
        found.to_owned()
    }

    /// Waits until an expression is true on the page.
    ///
    /// # Panics
    /// When it is not within a minute.
    pub fn wait_until(&mut self, expression: &str) {
        let deadline = Instant::now() + LIMIT;
        while self.value(&format!("Boolean({expression})")) != true {
            if Instant::now() >= deadline {
                let shown = self.value("document.body.innerText.slice(0, 600)");
                panic!(
                    "{expression}: not within {LIMIT:?}; load {}; the console has {:?}; the page shows {shown}",
                    load_average(),
                    self.complaints()
                );
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Presses the left button of the mouse on the middle of an element.
    ///
    /// # Panics
    /// When there is no such element.
    pub fn click(&mut self, selector: &str) {
        let place = self.value(&format!(
            "(() => {{ const one = document.querySelector({selector:?}); \
             one.scrollIntoView({{block: 'center'}}); const box = one.getBoundingClientRect(); \
             return [box.x + box.width / 2, box.y + box.height / 2]; }})()"
        ));
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({"type": kind, "x": place[0], "y": place[1], "button": "left", "clickCount": 1});
            self.ask("Input.dispatchMouseEvent", &event);
        }
    }

    /// Presses a key, e.g. `" "`, `8`, `Enter` or `ArrowLeft`.
    pub fn press(&mut self, key: &str) {
        let code = if key == " " { "Space" } else { key };
        let mut down = json!({"type": "keyDown", "key": key, "code": code});
        let is_enter = key == "Enter";
        if is_enter || key.chars().count() == 1 {
            down["text"] = if is_enter { "\r" } else { key }.into();
        }
        self.ask("Input.dispatchKeyEvent", &down);
        let up = json!({"type": "keyUp", "key": key, "code": code});
        self.ask("Input.dispatchKeyEvent", &up);
    }

    /// Writes a picture of what is in view, as PNG.
    ///
    /// # Panics
    /// When it cannot be taken or written.
    pub fn screenshot(&mut self, path: &Path) {
        let taken = self.ask("Page.captureScreenshot", &json!({"format": "png"}));
        let bytes = decoded(taken["data"].as_str().unwrap_or_default());
        assert!(bytes.starts_with(b"\x89PNG"), "no picture came");
        if let Err(error) = fs::write(path, bytes) {
            panic!("{}: {error}", path.display());
        }
    }

    /// Errors and warnings on the console so far, and exceptions that nobody caught.
    pub fn complaints(&mut self) -> Vec<String> {
        self.listen();
        self.complaints.clone()
    }

    /// Every address it asked for so far, sockets included; without those that name their own content.
    pub fn addresses(&mut self) -> Vec<String> {
        self.listen();
        self.addresses.clone()
    }

    /// Bytes received so far for pages, styles, scripts and the like; what sockets brought is not counted.
    pub fn received_bytes(&mut self) -> u64 {
        self.listen();
        self.received_bytes
    }

    fn listen(&mut self) {
        for event in self.wire.take_events() {
            if event["sessionId"] == self.session.as_str() {
                self.note(&event);
            }
        }
    }

    fn note(&mut self, event: &Value) {
        let facts = &event["params"];
        match event["method"].as_str().unwrap_or_default() {
            "Page.loadEventFired" => self.is_loaded = true,
            "Runtime.exceptionThrown" => self.complaints.push(facts.to_string()),
            "Runtime.consoleAPICalled" if is_grave(&facts["type"]) => {
                self.complaints.push(facts["args"].to_string());
            }
            "Log.entryAdded" if is_grave(&facts["entry"]["level"]) => {
                self.complaints.push(facts["entry"].to_string());
            }
            "Network.requestWillBeSent" => self.asked(&facts["request"]["url"]),
            "Network.webSocketCreated" => self.asked(&facts["url"]),
            "Network.loadingFinished" => {
                let bytes = facts["encodedDataLength"].as_f64().unwrap_or(0.0);
                #[allow(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "a count of bytes, given as a real number"
                )]
                let bytes = bytes.max(0.0) as u64;
                self.received_bytes += bytes;
            }
            _ => {}
        }
    }

    fn asked(&mut self, address: &Value) {
        let address = text(address);
        if !address.starts_with("data:") {
            self.addresses.push(address);
        }
    }
}

impl Drop for Page<'_> {
    fn drop(&mut self) {
        let close = json!({"targetId": self.target});
        self.wire.tell(None, "Target.closeTarget", &close);
    }
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_owned()
}

fn is_grave(level: &Value) -> bool {
    level == "error" || level == "warning" || level == "assert"
}

/// Bytes of base 64 text (RFC 4648, section 4).
fn decoded(text: &str) -> Vec<u8> {
    let sextets = text.bytes().filter_map(|letter| match letter {
        b'A'..=b'Z' => Some(letter - b'A'),
        b'a'..=b'z' => Some(letter - b'a' + 26),
        b'0'..=b'9' => Some(letter - b'0' + 52),
        b'+' => Some(62),
        b'/' => Some(63),
        _ => None,
    });
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut held, mut bit_count) = (0_u32, 0);
    for sextet in sextets {
        held = held << 6 & 0xffff | u32::from(sextet);
        bit_count += 6;
        if bit_count >= 8 {
            bit_count -= 8;
            bytes.push((held >> bit_count & 0xff) as u8);
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base_64_is_read_as_the_rfc_says() {
        for (text, bytes) in [
            ("", ""),
            ("Zg==", "f"),
            ("Zm8=", "fo"),
            ("Zm9v", "foo"),
            ("Zm9vYmFy", "foobar"),
        ] {
            assert_eq!(decoded(text), bytes.as_bytes());
        }
        assert_eq!(decoded("/+8="), [0xff, 0xef]);
    }
}
