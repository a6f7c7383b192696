// A text that is written once and read as Markdown or as a page of HTML.
//
// Not thread-safe.
#ifndef TRAIN_REPORT_DOCUMENT_H_
#define TRAIN_REPORT_DOCUMENT_H_

#include <string>
#include <vector>

namespace spikeserve {

class Document {
 public:
  void Title(const std::string& text);
  void Heading(const std::string& text);
  void Paragraph(const std::string& text);
  void Code(const std::string& text);
  // REQUIRES: rows as long as `header`.
  void Table(const std::vector<std::string>& header,
             const std::vector<std::vector<std::string>>& rows);
  // In HTML alone.
  void Figure(const std::string& svg);

  const std::string& Markdown() const { return markdown_; }
  std::string Html() const;

 private:
  std::string markdown_;
  std::string title_;
  std::string body_;
};

}  // namespace spikeserve

#endif  // TRAIN_REPORT_DOCUMENT_H_
