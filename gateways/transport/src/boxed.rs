//! A boxed transport is a transport. It adds nothing.

use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;

use hil_core::time::Instant;

use super::tcp::StreamFigures;
use super::{
    DatagramReceiver, DatagramSender, Received, ReceiverCounters, SendRefusal, SenderCounters,
};
use hil_net::radio::RadioReport;
use hil_net::{TransmitStamp, TxToken};
use hil_protocol::seal::SealCounts;

impl<S: DatagramSender + ?Sized> DatagramSender for Box<S> {
    fn send(&mut self, datagram: &[u8]) -> Result<TxToken, SendRefusal> {
        (**self).send(datagram)
    }

    fn next_stamp(&mut self) -> Option<TransmitStamp> {
        (**self).next_stamp()
    }

    fn next_radio_report(&mut self) -> Option<RadioReport> {
        (**self).next_radio_report()
    }

    fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        (**self).receive(buffer)
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        (**self).poll_fd()
    }

    fn counters(&self) -> SenderCounters {
        (**self).counters()
    }

    fn attend(&mut self, now: Instant) {
        (**self).attend(now);
    }

    fn next_due(&self) -> Option<Instant> {
        (**self).next_due()
    }

    fn has_unsent(&self) -> bool {
        (**self).has_unsent()
    }

    fn stream_figures(&self, now: Instant) -> Option<StreamFigures> {
        (**self).stream_figures(now)
    }

    fn seal_counts(&self) -> Option<SealCounts> {
        (**self).seal_counts()
    }
}

impl<R: DatagramReceiver + ?Sized> DatagramReceiver for Box<R> {
    fn receive(&mut self, now: Instant, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        (**self).receive(now, buffer)
    }

    fn reply(&mut self, datagram: &[u8], to: SocketAddr) -> Result<(), SendRefusal> {
        (**self).reply(datagram, to)
    }

    fn reply_stamped(
        &mut self,
        now: Instant,
        datagram: &[u8],
        to: SocketAddr,
    ) -> Result<(), SendRefusal> {
        (**self).reply_stamped(now, datagram, to)
    }

    fn take_reply_stamp(&mut self, now: Instant) -> Option<i64> {
        (**self).take_reply_stamp(now)
    }

    fn next_due(&self) -> Option<Instant> {
        (**self).next_due()
    }

    fn poll_fd(&self) -> Option<BorrowedFd<'_>> {
        (**self).poll_fd()
    }

    fn counters(&self) -> ReceiverCounters {
        (**self).counters()
    }

    fn attend(&mut self, now: Instant) {
        (**self).attend(now);
    }

    fn stream_figures(&self, now: Instant) -> Option<StreamFigures> {
        (**self).stream_figures(now)
    }

    fn seal_counts(&self) -> Option<SealCounts> {
        (**self).seal_counts()
    }
}
