//! `top` on a terminal: keys, pauses, resizes, and a terminal that is as it was when it ends,
//! however it ends.

use std::io;
use std::time::{Duration, Instant as WallInstant};

use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::draw::{Detail, Frame, draw};
use super::gather::Gatherer;
use super::view::View;
use crate::live::observer::{Observer, POLL_PERIOD};
use hil_platform::console::CommandEnd;
use hil_platform::signals::Signals;

/// Shows the run until the user leaves.
pub(super) fn run(
    observer: Observer,
    gatherer: Gatherer,
    window: Duration,
    signals: &Signals,
) -> io::Result<CommandEnd> {
    // Also sets a hook that restores the terminal before a panic is printed.
    let mut terminal = match ratatui::try_init() {
        Ok(terminal) => terminal,
        Err(error) => {
            // It may have failed half way, in raw mode; why it failed is what the user needs.
            let _is_restored = ratatui::try_restore().is_ok();
            return Err(error);
        }
    };
    let mut screen = Screen {
        view: None,
        chosen: 0,
        is_paused: false,
        shows_help: false,
        observer,
        gatherer,
        window,
    };
    let ended = screen.live(&mut terminal, signals);
    let restored = ratatui::try_restore();
    let end = ended?;
    restored?;
    Ok(end)
}

struct Screen {
    observer: Observer,
    gatherer: Gatherer,
    window: Duration,
    view: Option<View>,
    chosen: usize,
    is_paused: bool,
    shows_help: bool,
}

/// What a key asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wish {
    End,
    Up,
    Down,
    Pause,
    Help,
}

fn wish_of(key: KeyEvent) -> Option<Wish> {
    if key.kind == KeyEventKind::Release {
        return None;
    }
    let is_control = key.modifiers.contains(KeyModifiers::CONTROL);
    match key.code {
        KeyCode::Char('c') if is_control => Some(Wish::End),
        KeyCode::Char('q') | KeyCode::Esc => Some(Wish::End),
        KeyCode::Up | KeyCode::Char('k') => Some(Wish::Up),
        KeyCode::Down | KeyCode::Char('j') => Some(Wish::Down),
        KeyCode::Char(' ') => Some(Wish::Pause),
        KeyCode::Char('?' | 'h') => Some(Wish::Help),
        _ => None,
    }
}

impl Screen {
    fn live(
        &mut self,
        terminal: &mut DefaultTerminal,
        signals: &Signals,
    ) -> io::Result<CommandEnd> {
        let mut looked = WallInstant::now();
        let mut is_stale = true;
        loop {
            if signals.received().is_some() {
                return Ok(CommandEnd::Interrupted);
            }
            self.observer.poll();
            self.gatherer.read();
            let is_due = looked.elapsed() >= self.window || self.view.is_none();
            if is_due && !self.is_paused {
                looked = WallInstant::now();
                self.observer.trim(self.window);
                self.view = Some(self.gatherer.look(&self.observer, self.window));
                is_stale = true;
            } else if is_due {
                looked = WallInstant::now();
                self.observer.trim(self.window);
            }
            if is_stale {
                self.show(terminal)?;
                is_stale = false;
            }
            if !event::poll(POLL_PERIOD)? {
                continue;
            }
            is_stale = true;
            if let Event::Key(key) = event::read()?
                && self.does(wish_of(key))
            {
                return Ok(CommandEnd::Done);
            }
        }
    }

    /// Does what was asked for; true to end.
    fn does(&mut self, wish: Option<Wish>) -> bool {
        let count = self.view.as_ref().map_or(0, |view| view.channels.len());
        match wish {
            Some(Wish::End) => return true,
            Some(Wish::Up) => self.chosen = self.chosen.saturating_sub(1),
            Some(Wish::Down) => self.chosen = (self.chosen + 1).min(count.saturating_sub(1)),
            Some(Wish::Pause) => self.is_paused = !self.is_paused,
            Some(Wish::Help) => self.shows_help = !self.shows_help,
            None => {}
        }
        false
    }

    fn show(&self, terminal: &mut DefaultTerminal) -> io::Result<()> {
        let Some(view) = &self.view else {
            return Ok(());
        };
        let shown = Frame {
            detail: Detail::Chosen(self.chosen),
            is_paused: self.is_paused,
            shows_help: self.shows_help,
        };
        // Asks the terminal for its size, so that a resize needs nothing else.
        terminal.draw(|frame| draw(view, shown, frame.area(), frame.buffer_mut()))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_that_the_help_tells_of() {
        let wish = |code, modifiers| wish_of(KeyEvent::new(code, modifiers));
        let plain = |code| wish(code, KeyModifiers::NONE);
        assert_eq!(plain(KeyCode::Char('q')), Some(Wish::End));
        assert_eq!(plain(KeyCode::Esc), Some(Wish::End));
        assert_eq!(plain(KeyCode::Char('c')), None);
        assert_eq!(
            wish(KeyCode::Char('c'), KeyModifiers::CONTROL),
            Some(Wish::End)
        );
        assert_eq!(plain(KeyCode::Up), Some(Wish::Up));
        assert_eq!(plain(KeyCode::Char('j')), Some(Wish::Down));
        assert_eq!(plain(KeyCode::Char(' ')), Some(Wish::Pause));
        assert_eq!(plain(KeyCode::Char('?')), Some(Wish::Help));
        assert_eq!(plain(KeyCode::Char('x')), None);
    }
}
