// A publisher or subscription of std_msgs/msg/String over Fast DDS, named as ROS 2 names them, on the loopback interface only.
//
//   chatter pub DOMAIN TOPIC COUNT     waits for a subscription, then publishes "message 0" ... and waits for acknowledgements
//   chatter sub DOMAIN TOPIC COUNT     prints what it receives, a line each, until there are COUNT
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <mutex>
#include <string>
#include <thread>

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::IPLocator;
using eprosima::fastrtps::rtps::Locator_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

class StringType : public TopicDataType {
public:
    StringType() {
        setName("std_msgs::msg::dds_::String_");
        m_typeSize = 4 + 4 + 1024;
        m_isGetKeyDefined = false;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }

    bool serialize(void* data, SerializedPayload_t* payload) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
        eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::LITTLE_ENDIANNESS, eprosima::fastcdr::Cdr::DDS_CDR);
        payload->encapsulation = CDR_LE;
        cdr.serialize_encapsulation();
        cdr << *static_cast<std::string*>(data);
        payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
        return true;
    }

    bool deserialize(SerializedPayload_t* payload, void* data) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
        eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
        cdr.read_encapsulation();
        cdr >> *static_cast<std::string*>(data);
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return static_cast<uint32_t>(4 + 4 + static_cast<std::string*>(data)->size() + 1); };
    }

    void* createData() override { return new std::string(); }
    void deleteData(void* data) override { delete static_cast<std::string*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

class Printer : public DataReaderListener {
public:
    explicit Printer(int wanted) : left(wanted) {}

    void on_data_available(DataReader* reader) override {
        std::string text;
        SampleInfo info;
        while (reader->take_next_sample(&text, &info) == ReturnCode_t::RETCODE_OK) {
            if (info.valid_data) {
                std::cout << text << std::endl;
                --left;
            }
        }
    }

    std::atomic<int> left;
};

DomainParticipant* join(int domain) {
    DomainParticipantQos qos;
    qos.transport().use_builtin_transports = false;  // neither shared memory nor other interfaces
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.emplace_back("127.0.0.1");
    qos.transport().user_transports.push_back(udp);
    Locator_t peer;
    IPLocator::setIPv4(peer, 127, 0, 0, 1);
    peer.kind = LOCATOR_KIND_UDPv4;
    qos.wire_protocol().builtin.initialPeersList.push_back(peer);
    return DomainParticipantFactory::get_instance()->create_participant(domain, qos);
}

template <typename Condition>
bool until(Condition condition, int seconds) {
    for (int i = 0; i < seconds * 100; ++i) {
        if (condition()) return true;
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
    return false;
}

int main(int argc, char** argv) {
    if (argc != 5) return 2;
    const std::string mode = argv[1];
    const int domain = std::atoi(argv[2]), count = std::atoi(argv[4]);
    DomainParticipant* participant = join(domain);
    TypeSupport type(new StringType());
    type.register_type(participant);
    Topic* topic = participant->create_topic(argv[3], type.get_type_name(), TOPIC_QOS_DEFAULT);
    int status = 0;
    if (mode == "pub") {
        DataWriterQos qos;
        qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
        qos.history().kind = KEEP_ALL_HISTORY_QOS;
        DataWriter* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos);
        PublicationMatchedStatus matched;
        if (!until([&] { writer->get_publication_matched_status(matched); return matched.current_count > 0; }, 20)) return 3;
        for (int i = 0; i < count; ++i) {
            std::string text = "message " + std::to_string(i);
            writer->write(&text);
        }
        status = writer->wait_for_acknowledgments({20, 0}) == ReturnCode_t::RETCODE_OK ? 0 : 4;
    } else {
        Printer printer(count);
        DataReaderQos qos;
        qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
        qos.history().kind = KEEP_ALL_HISTORY_QOS;
        Subscriber* subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
        DataReader* reader = subscriber->create_datareader(topic, qos, &printer);
        status = until([&] { return printer.left <= 0; }, 30) ? 0 : 5;
        reader->set_listener(nullptr);
    }
    participant->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(participant);
    return status;
}
