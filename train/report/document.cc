#include "train/report/document.h"

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"

namespace spikeserve {
namespace {

std::string Escape(const std::string& text) {
  return absl::StrReplaceAll(text, {{"&", "&amp;"}, {"<", "&lt;"}, {">", "&gt;"}});
}

std::string HtmlRow(const std::vector<std::string>& cells, const char* tag) {
  std::string row = "<tr>";
  for (const std::string& cell : cells) {
    absl::StrAppend(&row, "<", tag, ">", Escape(cell), "</", tag, ">");
  }
  return row + "</tr>\n";
}

std::string MarkdownRow(const std::vector<std::string>& cells) {
  return absl::StrCat("| ", absl::StrJoin(cells, " | "), " |\n");
}

}  // namespace

void Document::Title(const std::string& text) {
  title_ = text;
  absl::StrAppend(&markdown_, "# ", text, "\n\n");
  absl::StrAppend(&body_, "<h1>", Escape(text), "</h1>\n");
}

void Document::Heading(const std::string& text) {
  absl::StrAppend(&markdown_, "## ", text, "\n\n");
  absl::StrAppend(&body_, "<h2>", Escape(text), "</h2>\n");
}

void Document::Paragraph(const std::string& text) {
  absl::StrAppend(&markdown_, text, "\n\n");
  absl::StrAppend(&body_, "<p>", Escape(text), "</p>\n");
}

void Document::Code(const std::string& text) {
  absl::StrAppend(&markdown_, "```\n", text, "\n```\n\n");
  absl::StrAppend(&body_, "<pre>", Escape(text), "</pre>\n");
}

void Document::Table(const std::vector<std::string>& header,
                     const std::vector<std::vector<std::string>>& rows) {
  absl::StrAppend(&markdown_, MarkdownRow(header),
                  MarkdownRow(std::vector<std::string>(header.size(), "---")));
  absl::StrAppend(&body_, "<table>\n", HtmlRow(header, "th"));
  for (const std::vector<std::string>& row : rows) {
    absl::StrAppend(&markdown_, MarkdownRow(row));
    absl::StrAppend(&body_, HtmlRow(row, "td"));
  }
  absl::StrAppend(&markdown_, "\n");
  absl::StrAppend(&body_, "</table>\n");
}

void Document::Figure(const std::string& svg) {
  absl::StrAppend(&body_, "<figure>", svg, "</figure>\n");
}

std::string Document::Html() const {
  return absl::StrCat(
      "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>", Escape(title_),
      "</title>\n<style>body{font-family:sans-serif;max-width:64em;margin:2em auto;padding:0 1em}"
      "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .6em;"
      "text-align:left}figure{display:inline-block;margin:.5em}pre{overflow:auto;background:#"
      "f4f4f4;"
      "padding:.6em}</style></head><body>\n",
      body_, "</body></html>\n");
}

}  // namespace spikeserve
