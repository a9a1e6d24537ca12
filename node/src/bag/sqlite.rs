//! rosbag2 sqlite3 files: opened so that nothing is ever written beside them, read one message at a time.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rusqlite::config::DbConfig;
use rusqlite::limits::Limit;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, OpenFlags, OptionalExtension};
use tempfile::TempDir;

use super::FileMessage;
use super::error::BagError;
use super::limits::{MAX_MESSAGE_BYTES, MAX_WAL_COPY_BYTES};
use super::locate::file_name;
use super::problems::Problems;
use super::topics::{FileTopic, FileTopics};

/// Everything needed to read an sqlite3 file's messages in order.
#[derive(Debug)]
pub(crate) struct SqliteIndex {
    /// The file as the user knows it.
    pub path: PathBuf,
    /// The file that is opened: the same, or a copy whose write-ahead log was merged.
    database: PathBuf,
    /// Keeps the copy alive.
    _copy: Option<TempDir>,
    /// Topics of the file.
    pub topics: Vec<FileTopic>,
    topic_of_id: BTreeMap<i64, usize>,
    /// First and last log time, nanoseconds, when there is a message.
    pub span_ns: Option<(i64, i64)>,
}

impl SqliteIndex {
    /// Reads the topics and counts the messages.
    pub fn open(path: &Path, problems: &Problems) -> Result<Self, BagError> {
        let (database, copy) =
            merged_copy(path, problems)?.map_or((path.to_owned(), None), |(db, dir)| (db, Some(dir)));
        let db = connect(&database, path)?;
        let message_columns = columns(&db, "messages").map_err(BagError::sqlite(path))?;
        let topic_columns = columns(&db, "topics").map_err(BagError::sqlite(path))?;
        for (table, columns, needed) in [
            ("topics", &topic_columns, &["id", "name", "type"][..]),
            ("messages", &message_columns, &["topic_id", "timestamp", "data"]),
        ] {
            if !columns.is_empty() && !is_plain_table(&db, table).map_err(BagError::sqlite(path))? {
                let found = format!("an sqlite3 database whose `{table}` is a view or a virtual table");
                return Err(BagError::NotABag { path: path.to_owned(), found });
            }
            if let Some(missing) = needed.iter().find(|n| !columns.iter().any(|c| c == *n)) {
                let found = match columns.as_slice() {
                    [] => format!("an sqlite3 database without a table `{table}`"),
                    _ => format!("an sqlite3 database whose table `{table}` has no column `{missing}`"),
                };
                return Err(BagError::NotABag { path: path.to_owned(), found });
            }
        }

        let mut topics = FileTopics::default();
        let mut topic_of_id = BTreeMap::new();
        // The first rosbag2 versions had no such column: everything was CDR.
        let serialization =
            if topic_columns.iter().any(|c| c == "serialization_format") { "serialization_format" } else { "'cdr'" };
        let mut rows = db
            .prepare(&format!("SELECT id, name, type, {serialization} FROM topics ORDER BY id"))
            .map_err(BagError::sqlite(path))?;
        let rows = rows
            .query_map((), |r| {
                let text = |i| r.get::<_, String>(i);
                Ok((r.get::<_, i64>(0)?, text(1)?, text(2)?, text(3)?))
            })
            .map_err(BagError::sqlite(path))?;
        for row in rows {
            match row {
                Ok((id, name, type_name, serialization)) => {
                    let serialization = if serialization.is_empty() { "cdr" } else { &serialization };
                    topic_of_id.insert(id, topics.index(&name, &type_name, serialization));
                }
                Err(e) => problems.add(format!("{}: a row of table `topics` cannot be read: {e}", file_name(path))),
            }
        }
        let mut index =
            Self { path: path.to_owned(), database, _copy: copy, topics: Vec::new(), topic_of_id, span_ns: None };
        for m in index.message_list(&db, problems)? {
            topics.count(m.topic, 1);
            let (a, b) = index.span_ns.unwrap_or((m.log_time_ns, m.log_time_ns));
            index.span_ns = Some((a.min(m.log_time_ns), b.max(m.log_time_ns)));
        }
        index.topics = topics.into_vec();
        Ok(index)
    }

    /// Every message's topic, time and row, in table order. The data stays where it is: 24 bytes per message.
    fn message_list(&self, db: &Connection, problems: &Problems) -> Result<Vec<Row>, BagError> {
        let mut out = Vec::new();
        let (mut odd, mut orphans) = (0u64, 0u64);
        let name = file_name(&self.path);
        let mut statement =
            db.prepare("SELECT topic_id, timestamp, rowid FROM messages").map_err(BagError::sqlite(&self.path))?;
        let mut rows = statement.query(()).map_err(BagError::sqlite(&self.path))?;
        loop {
            let row = match rows.next() {
                Ok(Some(row)) => row,
                Ok(None) => break,
                Err(e) => {
                    let n = out.len();
                    problems.add(format!("{name}: the database is damaged or cut off after {n} messages: {e}"));
                    break;
                }
            };
            let (Ok(id), Ok(log_time_ns), Ok(rowid)) = (row.get::<_, i64>(0), row.get(1), row.get(2)) else {
                odd += 1;
                continue;
            };
            match self.topic_of_id.get(&id) {
                Some(topic) => out.push(Row { log_time_ns, rowid, topic: *topic }),
                None => orphans += 1,
            }
        }
        if odd > 0 {
            problems.add(format!("{name}: {odd} messages have no integer topic or timestamp: skipped"));
        }
        if orphans > 0 {
            problems.add(format!("{name}: {orphans} messages belong to no topic of the bag: skipped"));
        }
        Ok(out)
    }
}

#[derive(Debug, Clone, Copy)]
struct Row {
    log_time_ns: i64,
    rowid: i64,
    topic: usize,
}

/// Reads an sqlite3 file's messages on the wanted topics.
pub(crate) struct SqliteStream {
    index: Arc<SqliteIndex>,
    db: Connection,
    rows: VecDeque<Row>,
}

impl SqliteStream {
    /// Starts reading; `wanted` says for each topic of the file whether its messages are.
    pub fn open(index: Arc<SqliteIndex>, wanted: &[bool], problems: &Problems) -> Result<Self, BagError> {
        let db = connect(&index.database, &index.path)?;
        let mut rows = index.message_list(&db, problems)?;
        rows.retain(|m| wanted.get(m.topic).copied().unwrap_or(false));
        rows.sort_by_key(|m| (m.log_time_ns, m.rowid));
        Ok(Self { index, db, rows: rows.into() })
    }

    /// The next message, or `None` at the end.
    pub fn next_message(&mut self) -> Option<Result<FileMessage, BagError>> {
        let row = self.rows.pop_front()?;
        Some(self.fetch(row).map_err(|why| BagError::Message {
            topic: self.index.topics.get(row.topic).map(|t| t.name.clone()).unwrap_or_default(),
            log_time_ns: row.log_time_ns,
            why,
        }))
    }

    fn fetch(&self, row: Row) -> Result<FileMessage, String> {
        let say = |e: rusqlite::Error| format!("the database cannot give row {}: {e}", row.rowid);
        let mut statement = self.db.prepare_cached("SELECT data FROM messages WHERE rowid = ?1").map_err(say)?;
        let mut rows = statement.query([row.rowid]).map_err(say)?;
        let found = rows.next().map_err(say)?.ok_or_else(|| format!("row {} is gone", row.rowid))?;
        let data = match found.get_ref(0).map_err(say)? {
            ValueRef::Blob(b) | ValueRef::Text(b) => b,
            other => return Err(format!("its data is {} instead of bytes", other.data_type())),
        };
        if data.len() as u64 > MAX_MESSAGE_BYTES {
            return Err(format!("{} bytes, over the limit of {MAX_MESSAGE_BYTES}", data.len()));
        }
        Ok(FileMessage { topic: row.topic, log_time_ns: row.log_time_ns, data: data.to_vec() })
    }
}

/// Opens `database` as an immutable file: no lock, no journal, no -shm beside it, so read-only folders work.
fn connect(database: &Path, path: &Path) -> Result<Connection, BagError> {
    let mut uri = String::from("file:");
    // A path that does not begin with a slash is relative in a URI as well.
    for byte in database.as_os_str().as_encoded_bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => uri.push(char::from(*byte)),
            _ => uri.push_str(&format!("%{byte:02x}")),
        }
    }
    uri.push_str("?immutable=1");
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let db = Connection::open_with_flags(uri, flags).map_err(BagError::sqlite(path))?;
    // A database is a program too: nothing in its schema may call functions with side effects, and no value may be larger
    // than a message.
    let guarded = || -> rusqlite::Result<()> {
        db.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)?;
        db.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
        db.set_limit(Limit::SQLITE_LIMIT_LENGTH, i32::try_from(MAX_MESSAGE_BYTES).unwrap_or(i32::MAX))?;
        Ok(())
    };
    guarded().map_err(BagError::sqlite(path))?;
    Ok(db)
}

/// Whether `table` is rows in the file: a view may give rows without end, and what a virtual table does is up to a module.
/// Neither has pages of its own.
fn is_plain_table(db: &Connection, table: &str) -> rusqlite::Result<bool> {
    let query = "SELECT rootpage FROM sqlite_schema WHERE type = 'table' AND name = ?1 COLLATE NOCASE";
    let page: Option<i64> = db.query_row(query, [table], |r| r.get(0)).optional()?;
    Ok(page.is_some_and(|page| page > 0))
}

fn columns(db: &Connection, table: &str) -> rusqlite::Result<Vec<String>> {
    let mut statement = db.prepare("SELECT name FROM pragma_table_info(?1)")?;
    statement.query_map([table], |r| r.get(0))?.collect()
}

/// A recorder that was killed leaves messages in `-wal`. They are merged in a copy, so that the bag stays as it is.
fn merged_copy(path: &Path, problems: &Problems) -> Result<Option<(PathBuf, TempDir)>, BagError> {
    let mut wal = path.as_os_str().to_owned();
    wal.push("-wal");
    let wal = PathBuf::from(wal);
    let Ok(wal_bytes) = std::fs::metadata(&wal).map(|m| m.len()) else { return Ok(None) };
    if wal_bytes == 0 {
        return Ok(None);
    }
    let bytes = std::fs::metadata(path).map_err(BagError::io(path))?.len().saturating_add(wal_bytes);
    let name = file_name(path);
    if bytes > MAX_WAL_COPY_BYTES {
        problems.add(format!(
            "{name}: {wal_bytes} bytes of {} are not read (the database is too large to merge a copy); \
             run `sqlite3 {name} 'PRAGMA wal_checkpoint'`",
            file_name(&wal)
        ));
        return Ok(None);
    }
    let merge = || -> Result<(PathBuf, TempDir), String> {
        let dir = TempDir::new().map_err(|e| e.to_string())?;
        let copy = dir.path().join("copy.db3");
        std::fs::copy(path, &copy).map_err(|e| e.to_string())?;
        std::fs::copy(&wal, dir.path().join("copy.db3-wal")).map_err(|e| e.to_string())?;
        let db = Connection::open(&copy).map_err(|e| e.to_string())?;
        db.query_row("PRAGMA wal_checkpoint(TRUNCATE)", (), |_| Ok(())).map_err(|e| e.to_string())?;
        Ok((copy, dir))
    };
    match merge() {
        Ok(merged) => Ok(Some(merged)),
        Err(e) => {
            problems
                .add(format!("{name}: its write-ahead log ({wal_bytes} bytes) cannot be merged and is left out: {e}"));
            Ok(None)
        }
    }
}
