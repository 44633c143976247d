//! The page over HTTP: one file that is part of the program, and where the socket is. It reads no file
//! and knows no other path, so there is nothing outside to reach. Nobody keeps a place for ever: asking
//! and taking the answer are both bounded in time.

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{self, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use serde_json::json;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::time::timeout;

use super::access::{Access, Refusal};
use super::front::{Newest, listen};

/// The page with its style and scripts, made of the folder `page` by the build script.
const PAGE: &str = include_str!(concat!(env!("OUT_DIR"), "/page.html"));

/// Nothing but the page's own script and style is run or drawn; the socket may be on any port that a
/// tunnel gives it.
const POLICY: &str = concat!(
    "default-src 'none'; script-src 'sha256-",
    include_str!(concat!(env!("OUT_DIR"), "/script.digest")),
    "'; style-src 'sha256-",
    include_str!(concat!(env!("OUT_DIR"), "/style.digest")),
    "'; connect-src 'self' ws:; img-src data:; base-uri 'none'; frame-ancestors 'none'; \
     form-action 'none'"
);

/// Connections at once; for a further one an old one goes.
const CONNECTIONS_MAX: usize = 64;
/// How long a browser may take to say what it wants; one that says nothing would keep its place
/// from the others.
const REQUEST_WITHIN: Duration = Duration::from_secs(5);
/// A browser's head has a few hundred bytes, and what it adds of its own.
const HEAD_BYTES_MAX: usize = 16 * 1024;
/// How long a connection may last: the page is small, and one that never reads it would keep its
/// place as well.
const SERVED_WITHIN: Duration = Duration::from_secs(30);
/// Bytes of an answer that the kernel keeps for one browser.
const KERNEL_BYTES: u32 = 32 * 1024;

/// Serves the page at `address` from now on; where it really is. The page will look for the socket
/// at `ws_port` of the same host. Requests to names that `access` does not know are refused.
///
/// # Errors
/// When the address cannot be had.
pub(crate) fn serve(
    runtime: &Handle,
    address: SocketAddr,
    ws_port: u16,
    access: Arc<Access>,
) -> io::Result<SocketAddr> {
    // What is unsent when a connection is closed is the kernel's, which would try for minutes.
    let listener = listen(runtime, address, SERVED_WITHIN, KERNEL_BYTES)?;
    let at = listener.local_addr()?;
    let config = json!({ "ws_port": ws_port, "version": env!("CARGO_PKG_VERSION") });
    let config = Bytes::from(config.to_string());
    runtime.spawn(attend(listener, config, access, SERVED_WITHIN));
    Ok(at)
}

/// Takes connections, and gives each at most `within` for all of it.
async fn attend(listener: TcpListener, config: Bytes, access: Arc<Access>, within: Duration) {
    let mut newest = Newest::new(CONNECTIONS_MAX);
    loop {
        let Ok((stream, from)) = listener.accept().await else {
            // Out of file descriptors, mostly: others must close first.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let served = serve_one(stream, config.clone(), Arc::clone(&access));
        // A browser that goes away in the middle, or is too slow, is nobody's fault.
        let task = tokio::spawn(async move { timeout(within, served).await.is_ok() });
        if newest.admit(from.ip(), task.abort_handle()) {
            access.count(&Refusal::Crowded(CONNECTIONS_MAX));
        }
    }
}

async fn serve_one(stream: TcpStream, config: Bytes, access: Arc<Access>) -> hyper::Result<()> {
    let service = service_fn(move |request: Request<Incoming>| {
        let hosts = request.headers().get_all(header::HOST).iter();
        let answer = match access.judge_page(hosts.map(HeaderValue::as_bytes)) {
            Ok(()) => answer(request.method(), request.uri().path(), &config),
            Err(refusal) => plain(refusal.status(), format!("{}\n", refusal.words())),
        };
        async move { Ok::<_, Infallible>(answer) }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(REQUEST_WITHIN)
        .keep_alive(false)
        .max_buf_size(HEAD_BYTES_MAX)
        .serve_connection(TokioIo::new(stream), service);
    connection.await
}

fn answer(method: &Method, path: &str, config: &Bytes) -> Response<Full<Bytes>> {
    if !matches!(*method, Method::GET | Method::HEAD) {
        let mut response = plain(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD\n");
        let allowed = HeaderValue::from_static("GET, HEAD");
        response.headers_mut().insert(header::ALLOW, allowed);
        return response;
    }
    match path {
        "/" => with_headers(StatusCode::OK, "text/html; charset=utf-8", PAGE.into()),
        "/config.json" => with_headers(StatusCode::OK, "application/json", config.clone()),
        _ => plain(StatusCode::NOT_FOUND, "no such file\n"),
    }
}

fn plain(status: StatusCode, words: impl Into<Bytes>) -> Response<Full<Bytes>> {
    with_headers(status, "text/plain; charset=utf-8", words.into())
}

fn with_headers(status: StatusCode, kind: &'static str, content: Bytes) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(content));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_TYPE, kind),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        // Another version of the program may be there at the next look.
        (header::CACHE_CONTROL, "no-cache"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};

    use tokio::net::TcpSocket;

    use super::*;

    /// No answer takes a tenth of this on an overloaded machine.
    const LIMIT: Duration = Duration::from_mins(1);

    fn get(path: &str) -> Response<Full<Bytes>> {
        answer(&Method::GET, path, &Bytes::from_static(b"{}"))
    }

    #[test]
    fn the_page_is_served_and_nothing_else() {
        let page = get("/");
        assert_eq!(page.status(), StatusCode::OK);
        assert_eq!(
            page.headers()[header::CONTENT_TYPE],
            "text/html; charset=utf-8"
        );
        assert_eq!(page.headers()[header::CONTENT_SECURITY_POLICY], POLICY);
        assert_eq!(
            get("/config.json").headers()[header::CONTENT_TYPE],
            "application/json"
        );
        for path in [
            "/../Cargo.toml",
            "/etc/passwd",
            "//index.html",
            "/%2e%2e/Cargo.toml",
            "",
        ] {
            assert_eq!(get(path).status(), StatusCode::NOT_FOUND, "{path}");
        }
        let put = answer(&Method::PUT, "/", &Bytes::new());
        assert_eq!(put.status(), StatusCode::METHOD_NOT_ALLOWED);
    }

    #[test]
    fn the_page_is_one_file_with_all_that_its_parts_have() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/page");
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            // Imports and exports are rewritten, links are replaced by what they name.
            let is_kept = |line: &&str| {
                !["import ", "export ", "<link rel=\"stylesheet", "<script"]
                    .iter()
                    .any(|start| line.starts_with(start))
            };
            for line in text.lines().filter(is_kept) {
                assert!(PAGE.contains(line), "{}: {line}", path.display());
            }
        }
        assert!(!PAGE.contains("src=") && !PAGE.contains("rel=\"stylesheet"));
    }
    /// A connection that has asked for `path`, with as little room for the answer as there can be.
    fn asked(runtime: &tokio::runtime::Runtime, at: SocketAddr, path: &str) -> std::net::TcpStream {
        let connected = runtime.block_on(async {
            let socket = TcpSocket::new_v4().unwrap();
            socket.set_recv_buffer_size(2048).unwrap();
            socket.connect(at).await.unwrap()
        });
        let mut stream = connected.into_std().unwrap();
        stream.set_nonblocking(false).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        stream
    }

    #[test]
    fn browsers_that_never_read_do_not_keep_all_places() {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let listener = listen(
            runtime.handle(),
            ([127, 0, 0, 1], 0).into(),
            SERVED_WITHIN,
            KERNEL_BYTES,
        )
        .unwrap();
        let at = listener.local_addr().unwrap();
        let access = Arc::new(Access::new(&[], &[], None));
        let config = Bytes::from_static(b"{}");
        runtime.spawn(attend(listener, config, access, Duration::from_millis(300)));
        let mut stuck: Vec<_> = (0..CONNECTIONS_MAX)
            .map(|_| asked(&runtime, at, "/"))
            .collect();
        let mut answer = String::new();
        let mut late = asked(&runtime, at, "/config.json");
        late.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200 OK"), "{answer}");
        // They were cut off, and not merely quick.
        let mut page = Vec::new();
        let read = stuck[0].read_to_end(&mut page);
        assert!(
            read.is_err() || page.len() < PAGE.len(),
            "{} bytes",
            page.len()
        );
    }
}
