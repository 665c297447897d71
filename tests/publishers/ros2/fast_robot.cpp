// A robot with Fast DDS: receives one topic of raw CDR messages and prints each message as hexadecimal digits.
// fast_robot DOMAIN TOPIC TYPE best_effort|reliable: ends with its standard input
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <poll.h>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

class RawType : public TopicDataType {
public:
  explicit RawType(const std::string & name) { setName(name.c_str()); m_typeSize = 65536; m_isGetKeyDefined = false; }
  bool serialize(void *, SerializedPayload_t *) override { return false; }
  bool deserialize(SerializedPayload_t * from, void * to) override {
    static_cast<std::vector<unsigned char> *>(to)->assign(from->data, from->data + from->length);
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void *) override { return [] { return 0u; }; }
  void * createData() override { return new std::vector<unsigned char>; }
  void deleteData(void * data) override { delete static_cast<std::vector<unsigned char> *>(data); }
  bool getKey(void *, InstanceHandle_t *, bool) override { return false; }
};

int main(int, char ** argv) {
  auto factory = DomainParticipantFactory::get_instance();
  auto participant = factory->create_participant(std::atoi(argv[1]), PARTICIPANT_QOS_DEFAULT);
  if (participant == nullptr) return 2;
  TypeSupport type(new RawType(argv[3]));
  type.register_type(participant);
  auto topic = participant->create_topic(argv[2], argv[3], TOPIC_QOS_DEFAULT);
  DataReaderQos qos = DATAREADER_QOS_DEFAULT;
  bool reliable = std::strcmp(argv[4], "best_effort") != 0;
  qos.reliability().kind = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
  bool kept = std::strcmp(argv[4], "kept") == 0;
  qos.durability().kind = kept ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
  qos.history().kind = KEEP_LAST_HISTORY_QOS;
  qos.history().depth = 4000;
  auto reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos);
  std::printf("ready\n");
  std::fflush(stdout);
  std::vector<unsigned char> sample;
  SampleInfo info;
  pollfd input{0, POLLIN, 0};
  bool ended = false;
  while (!ended) {
    ended = poll(&input, 1, 10) > 0;
    while (reader->take_next_sample(&sample, &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data) continue;
      for (unsigned char one : sample) std::printf("%02x", one);
      std::printf("\n");
      std::fflush(stdout);
    }
  }
  std::_Exit(0);
}
