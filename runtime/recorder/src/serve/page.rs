//! The page over HTTP: one file that is part of the program, and where the socket is. It reads no file
//! and knows no other path, so there is nothing outside to reach.

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
use tokio::net::TcpListener;
use tokio::runtime::Handle;

use super::access::{Access, Refusal};

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

/// Connections at once; more wait.
const CONNECTIONS_MAX: usize = 64;
/// How long a browser may take to say what it wants; one that says nothing would keep its place
/// from the others.
const REQUEST_WITHIN: Duration = Duration::from_secs(5);

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
    let listener = runtime.block_on(TcpListener::bind(address))?;
    let at = listener.local_addr()?;
    let config = json!({ "ws_port": ws_port, "version": env!("CARGO_PKG_VERSION") });
    let config = Bytes::from(config.to_string());
    runtime.spawn(async move {
        let room = Arc::new(tokio::sync::Semaphore::new(CONNECTIONS_MAX));
        loop {
            let Ok(place) = Arc::clone(&room).acquire_owned().await else {
                return;
            };
            let Ok((stream, _)) = listener.accept().await else {
                // Out of file descriptors, mostly: others must close first.
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            };
            let (config, access) = (config.clone(), Arc::clone(&access));
            tokio::spawn(async move {
                let service = service_fn(move |request: Request<Incoming>| {
                    let hosts = request.headers().get_all(header::HOST).iter();
                    let answer = match access.judge_page(hosts.map(HeaderValue::as_bytes)) {
                        Ok(()) => answer(request.method(), request.uri().path(), &config),
                        Err(refusal) => refused(&refusal),
                    };
                    async move { Ok::<_, Infallible>(answer) }
                });
                let connection = http1::Builder::new()
                    .timer(TokioTimer::new())
                    .header_read_timeout(REQUEST_WITHIN)
                    .keep_alive(false)
                    .serve_connection(TokioIo::new(stream), service);
                // A browser that goes away in the middle is nobody's fault.
                let _is_served = connection.await.is_ok();
                drop(place);
            });
        }
    });
    Ok(at)
}

fn answer(method: &Method, path: &str, config: &Bytes) -> Response<Full<Bytes>> {
    if !matches!(*method, Method::GET | Method::HEAD) {
        let mut response = plain(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD\n");
        let allowed = HeaderValue::from_static("GET, HEAD");
        response.headers_mut().insert(header::ALLOW, allowed);
        return response;
    }
    match path {
        "/" => found(
            "text/html; charset=utf-8",
            Bytes::from_static(PAGE.as_bytes()),
        ),
        "/config.json" => found("application/json", config.clone()),
        _ => plain(StatusCode::NOT_FOUND, "no such file\n"),
    }
}

fn found(kind: &'static str, content: Bytes) -> Response<Full<Bytes>> {
    with_headers(StatusCode::OK, kind, content)
}

fn plain(status: StatusCode, words: &'static str) -> Response<Full<Bytes>> {
    with_headers(
        status,
        "text/plain; charset=utf-8",
        Bytes::from_static(words.as_bytes()),
    )
}

fn refused(refusal: &Refusal) -> Response<Full<Bytes>> {
    let (code, _) = refusal.status();
    let status = StatusCode::from_u16(code).unwrap_or(StatusCode::FORBIDDEN);
    let words = format!("{}\n", refusal.words());
    with_headers(status, "text/plain; charset=utf-8", Bytes::from(words))
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
    use super::*;

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
}
